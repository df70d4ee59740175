"""`roboneuron policy cubes monitor`: train, calibrate and judge the monitor of success."""

from __future__ import annotations

import json
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rn_policy_cubes.command_options import (
    add_settings,
    add_threads,
    say,
    told_settings,
    use_threads,
    values_checked,
)
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from rn_policy_cubes.monitor.weights import MonitorWeights

MONITOR_DIRECTORY = Path("out/cubes-monitor")
EPISODES: Mapping[str, Mapping[str, tuple[int, int]]] = {
    "train": {
        "success": (0, 30),
        "dropped": (0, 24),
        "wrong_cube": (0, 36),
        "no_grasp": (0, 12),
        "pushed": (0, 8),
        "occluded": (0, 16),
    },
    "calibration": {
        "success": (30, 45),
        "dropped": (24, 32),
        "wrong_cube": (36, 48),
        "no_grasp": (12, 16),
        "pushed": (8, 11),
        "occluded": (16, 22),
    },
    "test": {
        "success": (45, 100),
        "dropped": (32, 80),
        "wrong_cube": (48, 172),
        "no_grasp": (16, 50),
        "pushed": (11, 40),
        "frozen": (0, 30),
        "occluded": (22, 60),
    },
}
"""First and end of the numbers of episodes by kind: for training, for the choice of the
thresholds, and unseen ones to judge. All are of different scenes.
"""
_TRAINED, _PACKED = "trained.safetensors", "cubes-monitor.safetensors"


def configure_monitor(parser: ArgumentParser) -> None:
    """Add the arguments of `roboneuron policy cubes monitor`."""
    steps = parser.add_subparsers(dest="step", required=True, metavar="STEP", help="what to do")
    for name, text in (
        ("train", "record episodes, train, and choose the thresholds, or continue"),
        ("evaluate", "record unseen episodes, judge them, write table and ROC curves"),
    ):
        step = steps.add_parser(name, help=text)
        add = step.add_argument
        add("--out", type=Path, default=MONITOR_DIRECTORY, help="default: %(default)s")
        add("--share", type=float, default=1.0, help="share of the episodes (default: 1)")
        if name == "train":
            add_threads(step)
            add_settings(step)
        else:
            add("--weights", type=Path, help="default: OUT/cubes-monitor.safetensors if it exists")


def run_monitor(arguments: Namespace) -> int:
    """Run `roboneuron policy cubes monitor`."""
    if not 0.0 < arguments.share <= 1.0:
        raise ConfigurationError(
            f"--share is {arguments.share:g}, expected more than 0 and up to 1."
        )
    if arguments.step == "train":
        return _train(arguments)
    return _evaluate(arguments)


def episodes_of(split: str, share: float) -> dict[str, int]:
    """Number of episodes by kind; at least one of each."""
    return {
        kind: max(1, round(share * (end - first))) for kind, (first, end) in EPISODES[split].items()
    }


def recorded(out: Path, split: str, share: float) -> list[Path]:
    """Record the episodes of a split that are missing; return the files of all."""
    from rn_policy_cubes.monitor.episodes import path_of, write_episode
    from rn_policy_cubes.progress import Progress

    directory, wanted = out / "episodes", episodes_of(split, share)
    order = [
        (kind, EPISODES[split][kind][0] + number)
        for kind, count in wanted.items()
        for number in range(count)
    ]
    missing = [pair for pair in order if not path_of(directory, *pair).exists()]
    done = len(order) - len(missing)
    progress = Progress(f"episode ({split})", len(order), done, say)
    for number, (kind, index) in enumerate(missing, 1):
        write_episode(directory, kind, index)
        progress.update(done + number)
    return sorted(path_of(directory, kind, index) for kind, index in order)


def _train(arguments: Namespace) -> int:
    use_threads(arguments.threads)
    from rn_policy_cubes.monitor.fitting import MonitorRecipe, fit
    from rn_policy_cubes.monitor.layers import MonitorLayers
    from rn_policy_cubes.monitor.samples import Samples
    from rn_policy_cubes.monitor.weights import MonitorCard, MonitorWeights

    out, share = arguments.out, arguments.share
    with values_checked():
        recipe = MonitorRecipe.model_validate(told_settings(arguments.set))
    paths = recorded(out, "train", share)
    network, step = fit(Samples.read(paths), recipe, out, say)
    card = MonitorCard(recipe=recipe.model_dump(), step=step, episodes=episodes_of("train", share))
    weights = MonitorWeights(card, MonitorLayers(network.tensors()))
    weights.write(out / _TRAINED)
    # as a task reads them: in half precision
    calibrated = _calibrated(MonitorWeights.read(out / _TRAINED), out, share)
    calibrated.write(out / _PACKED)
    say(f"{out / _PACKED}: {(out / _PACKED).stat().st_size / 1e3:.0f} kB")
    return 0


def _calibrated(weights: MonitorWeights, out: Path, share: float) -> MonitorWeights:
    from rn_policy_cubes.monitor.assessment import judge_files, write_judged
    from rn_policy_cubes.monitor.layers import MonitorLayers
    from rn_policy_cubes.monitor.statistics import threshold
    from rn_policy_cubes.monitor.weights import MonitorWeights as Weights

    judged = judge_files(recorded(out, "calibration", share), weights)
    write_judged(out / "calibration.jsonl", judged)
    good = [each for each in judged if each.is_success]
    bad = [each for each in judged if not each.is_success]
    success = threshold([each.success for each in good], [each.success for each in bad])
    failure = threshold([each.failure for each in bad], [each.failure for each in good])
    counts = {kind: sum(each.kind == kind for each in judged) for kind in EPISODES["calibration"]}
    card = weights.card.model_copy(
        update={
            "success_threshold": success,
            "failure_threshold": failure,
            "calibrated_on": counts,
        }
    )
    say(f"thresholds: success {success:.4f}, failure {failure:.4f}")
    return Weights(card, MonitorLayers(weights.layers.tensors))


def _evaluate(arguments: Namespace) -> int:
    from rn_policy_cubes.monitor.assessment import judge_files, summary, table, write_judged
    from rn_policy_cubes.monitor.roc_plot import roc_svg
    from rn_policy_cubes.monitor.weights import MonitorWeights, shipped_monitor

    out, path = arguments.out, arguments.weights
    if path is None:
        path = out / _PACKED if (out / _PACKED).exists() else shipped_monitor()
    paths = recorded(out, "test", arguments.share)
    judged = judge_files(paths, MonitorWeights.read(path))
    write_judged(out / "test.jsonl", judged)
    figures = summary(judged)
    (out / "test.json").write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
    (out / "roc.svg").write_text(roc_svg(judged), encoding="utf-8")
    say(table(judged))
    say(json.dumps(figures, indent=1))
    say(f"{len(paths) - len(judged)} of {len(paths)} episodes were not of their kind")
    say(f"{out / 'test.jsonl'}, {out / 'test.json'}, {out / 'roc.svg'}")
    return 0
