"""`roboneuron policy check` compares a policy served by SGLang or vLLM-Omni (stand-ins) with
recorded actions, through the engine's profile.
"""

from __future__ import annotations

import json
from argparse import ArgumentParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_engines import CAMERAS, SglangStandIn, VllmOmniStandIn
from numpy.typing import NDArray
from policy_datasets import write_dataset
from policy_world import HORIZON, JOINTS, MARGIN, RATE_HZ, SIZE, actions, row_of

from rn_recorder_policy.command import CheckPolicy
from rn_testing.fakes.site import PluginSite, plugin_site

KINDS = {"sglang": "quantiles", "vllm-omni": "mean_std"}
ENGINES = {"sglang": SglangStandIn, "vllm-omni": VllmOmniStandIn}
CONFIG = """
[robot]
name = "toy"
[inference]
backend = "openpi"
[control]
controller = "toy"
[plugins.openpi]
engine = "{engine}"
url = "{url}"
profile = "own"
joints = {joints}
image_keys = {{ primary = "observation.images.base_0_rgb" }}
state_keys = {{ state = ["joints", "gripper_open"] }}
normalisation = {{ file = "{statistics}", kind = "{kind}" }}
[plugins.openpi.action]
kind = "joint_position"
gripper = "open_fraction"
rate_hz = {rate_hz}
"""


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("is_wrong", [False, True])
def test_a_served_network_is_compared_with_recorded_actions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], engine: str, is_wrong: bool
) -> None:
    """A network whose sixth joint has the other sign is found out."""
    known, kind = actions("joint_position"), KINDS[engine]
    part = {
        "mean": known.mean(axis=0).tolist(),
        "std": known.std(axis=0).tolist(),
        "q01": known.min(axis=0).tolist(),
        "q99": known.max(axis=0).tolist(),
    }
    statistics = tmp_path / "norm_stats.json"
    statistics.write_text(json.dumps({"norm_stats": {"state": part, "actions": part}}))

    def network(images: dict[str, Any], state: Any, prompt: str) -> NDArray[np.float64]:
        image = images[CAMERAS[0]]
        row = row_of(image[:: len(image) // SIZE, :: len(image) // SIZE])
        rows = known[MARGIN + row : MARGIN + row + HORIZON].copy()
        if is_wrong:
            rows[:, 5] *= -1.0
        if kind == "mean_std":
            return (rows - part["mean"]) / (np.array(part["std"]) + 1e-6)
        low, high = np.array(part["q01"]), np.array(part["q99"])
        return 2.0 * (rows - low) / (high - low + 1e-6) - 1.0

    server = ENGINES[engine](network)
    server.start()
    config = tmp_path / "roboneuron.toml"
    config.write_text(
        CONFIG.format(
            engine=engine,
            url=server.url,
            joints=json.dumps(JOINTS),
            statistics=statistics,
            kind=kind,
            rate_hz=RATE_HZ,
        )
    )
    data = write_dataset(tmp_path / "set", "joint_position")
    try:
        with plugin_site(tmp_path / "site") as site:
            assert isinstance(site, PluginSite)
            site.install("rn-toy", "", value="policy_plugin")
            parser, command = ArgumentParser(), CheckPolicy()
            command.configure(parser)
            words = ["--config", str(config), "--dataset", str(data), "--episode", "1"]
            status = command.run(parser.parse_args(words))
    finally:
        server.stop()
    told = capsys.readouterr().out
    assert status == int(is_wrong), told
    assert ("sign: joint6" in told) == is_wrong, told
