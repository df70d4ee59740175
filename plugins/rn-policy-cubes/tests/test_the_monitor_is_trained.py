"""Training of the monitor's network, and the network in NumPy."""

from __future__ import annotations

import subprocess
import sys
from argparse import ArgumentParser
from pathlib import Path

import numpy as np
import pytest
import torch

from rn_policy_cubes.command import CubesPolicy
from rn_policy_cubes.monitor import command as monitor_command
from rn_policy_cubes.monitor.fitting import MonitorNetwork, MonitorRecipe, fit
from rn_policy_cubes.monitor.layers import MonitorLayers, scaled
from rn_policy_cubes.monitor.samples import Samples
from rn_policy_cubes.monitor.views import close_view, whole_view
from rn_policy_cubes.monitor.weights import MonitorCard, MonitorWeights
from rn_robot_fr3.cameras import cameras
from roboneuron import ConfigurationError


def some_samples(count: int = 12) -> Samples:
    random = np.random.default_rng(3)
    return Samples(
        close=random.integers(0, 256, (count, 48, 48, 3), dtype=np.uint8),
        whole=random.integers(0, 256, (count, 56, 56, 3), dtype=np.uint8),
        state=random.normal(size=(count, 4)).astype(np.float32),
        labels=random.integers(0, 2, (count, 3, 4)).astype(np.float32),
        known=np.ones((count, 3, 4), dtype=np.float32),
    )


def test_numpy_computes_what_torch_does() -> None:
    torch.manual_seed(5)
    network, samples = MonitorNetwork().eval(), some_samples(3)
    told = MonitorLayers(network.tensors())(samples.close, samples.whole, samples.state)
    with torch.no_grad():
        true = network(
            torch.from_numpy(scaled(samples.close)),
            torch.from_numpy(scaled(samples.whole)),
            torch.from_numpy(samples.state),
        )
    true[:, 1] = true[:, 1].sigmoid()
    # float32 sums in another order
    np.testing.assert_allclose(told, true.numpy(), atol=1e-4)


def test_a_training_continues_where_it_was(tmp_path: Path) -> None:
    recipe, samples = MonitorRecipe(steps=4, views=4), some_samples()
    whole, done = fit(samples, recipe, tmp_path / "whole", lambda line: None)
    assert done == 4
    _, half = fit(samples, recipe, tmp_path / "parts", lambda line: None, until=2)
    assert half == 2
    parts, _ = fit(samples, recipe, tmp_path / "parts", lambda line: None)
    for name, tensor in whole.tensors().items():
        np.testing.assert_array_equal(tensor, parts.tensors()[name])


def test_the_state_of_another_recipe_is_refused(tmp_path: Path) -> None:
    fit(some_samples(), MonitorRecipe(steps=1, views=2), tmp_path, lambda line: None)
    with pytest.raises(ConfigurationError, match="another recipe"):
        fit(some_samples(), MonitorRecipe(steps=2, views=2), tmp_path, lambda line: None)


def test_weights_survive_their_file(tmp_path: Path) -> None:
    network, samples = MonitorNetwork(), some_samples(2)
    card = MonitorCard(recipe={"steps": 1}, step=1, episodes={"success": 2}, success_threshold=0.7)
    weights = MonitorWeights(card, MonitorLayers(network.tensors()))
    weights.write(tmp_path / "weights")
    again = MonitorWeights.read(tmp_path / "weights")
    assert again.card == card
    told, read = (w.layers(samples.close, samples.whole, samples.state) for w in (weights, again))
    # half precision
    np.testing.assert_allclose(told, read, atol=5e-3)
    assert (tmp_path / "weights").stat().st_size < 500_000


def test_views_do_not_depend_on_the_size_of_the_picture() -> None:
    small = np.random.default_rng(0).integers(0, 256, (224, 224, 3), dtype=np.uint8)
    large = small.repeat(2, axis=0).repeat(2, axis=1)
    tcp_m = np.array([0.5, 0.05, 0.2])
    views = [
        close_view(picture, cameras()[0].calibration(*picture.shape[1::-1]), tcp_m)
        for picture in (small, large)
    ]
    np.testing.assert_array_equal(*views)
    np.testing.assert_array_equal(whole_view(small), whole_view(large))
    assert whole_view(small[:, :100]).shape == whole_view(small[:40, :40]).shape == (56, 56, 3)
    outside = close_view(small, cameras()[0].calibration(224, 224), np.array([0.5, 3.0, 0.2]))
    assert outside.shape == (48, 48, 3)


def test_a_server_with_the_monitor_imports_no_torch() -> None:
    code = (
        "import sys; from rn_policy_cubes.monitor.success import CubesSuccess; "
        "CubesSuccess(None); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.slow
def test_from_nothing_to_a_judged_monitor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few = {
        split: {"success": (number, number + 1), "wrong_cube": (number, number + 1)}
        for number, split in enumerate(monitor_command.EPISODES)
    }
    monkeypatch.setattr(monitor_command, "EPISODES", few)
    parser, command = ArgumentParser(), CubesPolicy()
    command.configure(parser)
    words = ["monitor", "train", "--out", str(tmp_path), "--set", "steps=2", "--set", "views=4"]
    assert command.run(parser.parse_args(words)) == 0
    assert command.run(parser.parse_args(["monitor", "evaluate", "--out", str(tmp_path)])) == 0
    said = capsys.readouterr().out
    assert "thresholds: success" in said
    assert "| wrong_cube | 1 |" in said
    card = MonitorWeights.read(tmp_path / "cubes-monitor.safetensors").card
    assert card.calibrated_on == {"success": 1, "wrong_cube": 1}
    for name in ("test.jsonl", "test.json", "roc.svg", "calibration.jsonl"):
        assert (tmp_path / name).stat().st_size > 0


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["train", "--share", "0"], "--share is 0"),
        (["evaluate", "--share", "2"], "--share is 2"),
        (["train", "--set", "colour=red"], "colour: Extra inputs"),
    ],
)
def test_wrong_words_are_refused(words: list[str], text: str, tmp_path: Path) -> None:
    parser, command = ArgumentParser(), CubesPolicy()
    command.configure(parser)
    with pytest.raises(ConfigurationError, match=text):
        command.run(parser.parse_args(["monitor", *words, "--out", str(tmp_path)]))
