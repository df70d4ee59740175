"""The command `roboneuron cubes-policy`."""

from __future__ import annotations

import json
import os
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from rn_policy_cubes.flow.command import configure_flow, run_flow
from rn_policy_cubes.monitor.command import configure_monitor, run_monitor
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from pydantic import ValidationError

    from rn_policy_cubes.packing import Packed
    from rn_policy_cubes.recipe import Recipe

DEFAULT_DIRECTORY = Path("out/train-cubes")
IMPROVED_DIRECTORY = Path("out/improve-cubes")
_FUSE_HELP = "compile the layers: half the time; needs C++"


class CubesPolicy:
    """A small learned policy for the suite "cubes": training, and export as a checkpoint in the
    OpenVLA-OFT layout, or, as a flow policy, in pi0's.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron cubes-policy`."""
        actions = parser.add_subparsers(
            dest="action", required=True, metavar="ACTION", help="action to run"
        )
        train = actions.add_parser("train", help="make demonstrations and train, or continue")
        train.add_argument(
            "--out", type=Path, default=DEFAULT_DIRECTORY, help="default: %(default)s"
        )
        train.add_argument(
            "--data", type=Path, help="folder of the demonstrations; default: OUT/demonstrations"
        )
        train.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="NAME=VALUE",
            help="set a value of the recipe: steps=500",
        )
        train.add_argument(
            "--until", type=int, metavar="STEP", help="stop at this step, to continue later"
        )
        train.add_argument(
            "--workers", type=int, default=1, help="processes that make demonstrations (default: 1)"
        )
        train.add_argument(
            "--threads", type=int, default=1, help="threads of the training on a CPU (default: 1)"
        )
        train.add_argument("--fuse", action="store_true", help=_FUSE_HELP)
        _configure_improve(
            actions.add_parser(
                "improve",
                help="train on the policy's failures, compare, promote if it is not worse",
            )
        )
        rollback = actions.add_parser("rollback", help="return to the policy before the promotion")
        rollback.add_argument(
            "--out", type=Path, default=IMPROVED_DIRECTORY, help="default: %(default)s"
        )
        configure_monitor(
            actions.add_parser("monitor", help="train and judge the monitor of success")
        )
        pack = actions.add_parser("pack", help="write the trained weights as one small file")
        pack.add_argument(
            "--out", type=Path, default=DEFAULT_DIRECTORY, help="folder of the training"
        )
        pack.add_argument("--to", type=Path, required=True, metavar="FILE", help="the packed file")
        unpack = actions.add_parser(
            "unpack", help="write a checkpoint that the backend oft-primary loads"
        )
        unpack.add_argument("directory", type=Path, help="a new or empty folder")
        unpack.add_argument(
            "--weights", type=Path, help="a packed file; default: the one in this package"
        )
        configure_flow(actions.add_parser("flow", help="the same skill as a pi0 flow policy"))

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron cubes-policy`."""
        match arguments.action:
            case "train":
                return _train(arguments)
            case "improve":
                return _improve(arguments)
            case "rollback":
                return _roll_back(arguments)
            case "monitor":
                return _monitor(arguments)
            case "pack":
                return _pack(arguments)
            case "flow":
                return run_flow(arguments)
            case _:
                return _unpack(arguments)


def _configure_improve(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("--out", type=Path, default=IMPROVED_DIRECTORY, help="default: %(default)s")
    add("--weights", type=Path, help="packed file of the first champion; default: the shipped one")
    add(
        "--corrections",
        type=Path,
        action="append",
        default=[],
        metavar="DATASET",
        help="LeRobot data set in which people corrected the policy; repeatable",
    )
    for name, default, text in (
        ("shards", 8, "shards of demonstrations"),
        ("rollouts", 3, "shards of the champion's own rollouts, labelled by the teacher"),
        ("views", 256, "images of a shard"),
        ("steps", 300, "training steps"),
        ("seeds", 40, "unseen scenes of the evaluation"),
    ):
        add(f"--{name}", type=int, default=default, help=f"{text} (default: %(default)s)")
    add(
        "--suite-option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="evaluate on scenes with this option too, as of `roboneuron eval run`; repeatable",
    )
    add("--time-limit", type=float, default=30.0, metavar="S", help="of a scene [s] (default: 30)")
    add(
        "--margin",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="promote although it solves up to this share of the scenes fewer, unless the paired "
        "test finds that significant (default: 0)",
    )
    add(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="set a value of the training's recipe: rate=0.0005",
    )
    add("--threads", type=int, default=1, help="threads of the training on a CPU (default: 1)")
    add("--fuse", action="store_true", help=_FUSE_HELP)


def _improve(arguments: Namespace) -> int:
    """Run the rounds; status 0 also if the champion stays."""
    os.environ["OMP_NUM_THREADS"] = str(arguments.threads)
    import torch
    from pydantic import ValidationError

    from rn_policy_cubes.improvement_ledger import alone_in
    from rn_policy_cubes.improving import ELSEWHERE, RoundPlan, Wheel, recipe_of_round
    from rn_policy_cubes.weights import shipped_weights

    torch.set_num_threads(arguments.threads)
    try:
        plan = RoundPlan(
            recipe=recipe_of_round(arguments.shards, arguments.steps, settings_of(arguments.set)),
            rollouts=arguments.rollouts,
            views=arguments.views,
            seeds=arguments.seeds,
            time_limit_s=arguments.time_limit,
            suite_options=tuple(arguments.suite_option),
            margin=arguments.margin,
        )
    except ValidationError as error:
        raise wrong_value(error) from None
    with alone_in(arguments.out):
        wheel = Wheel(arguments.out, say, fuse=arguments.fuse)
        number = wheel.begin(arguments.weights or shipped_weights(), plan, arguments.corrections)
        tests = wheel.run(number)
        is_promoted = wheel.champion == number
        for name, test in tests.items():
            options = plan.suite_options if name == ELSEWHERE else ()
            say(f"round {number}, {' '.join([f'{test.seeds} unseen scenes', *options])}: {test}")
        say("the challenger is promoted" if is_promoted else "it is worse: the champion stays")
        say(f"the champion: {wheel.checkpoint(wheel.champion)}")
    return 0


def _monitor(arguments: Namespace) -> int:
    os.environ["OMP_NUM_THREADS"] = str(getattr(arguments, "threads", 1))
    return run_monitor(arguments, settings_of(getattr(arguments, "set", [])), say)


def _roll_back(arguments: Namespace) -> int:
    from rn_policy_cubes.improvement_ledger import LEDGER_FILE, alone_in
    from rn_policy_cubes.improving import Wheel

    if not (arguments.out / LEDGER_FILE).exists():
        raise ConfigurationError(
            f"{arguments.out} holds no improved policy.",
            hint="Begin: roboneuron cubes-policy improve",
        )
    with alone_in(arguments.out):
        wheel = Wheel(arguments.out, say)
        gone, back = wheel.roll_back()
        print(f"round {gone} is rolled back; the champion: {wheel.checkpoint(back)}")
    return 0


def _train(arguments: Namespace) -> int:
    os.environ["OMP_NUM_THREADS"] = str(arguments.threads)
    import torch

    from rn_policy_cubes.record import record
    from rn_policy_cubes.training import train

    torch.set_num_threads(arguments.threads)
    recipe = _recipe(arguments.set)
    data = arguments.data or arguments.out / "demonstrations"
    record(data, recipe.shards, workers=arguments.workers, say=say)
    training = train(
        recipe, arguments.out, data, until=arguments.until, fuse=arguments.fuse, say=say
    )
    print(f"step {training.step} of {recipe.steps}, state in {arguments.out}")
    return 0


def say(line: str) -> None:
    """Print immediately, also into a file or a pipe."""
    print(line, flush=True)


def _recipe(settings: list[str]) -> Recipe:
    from pydantic import ValidationError

    from rn_policy_cubes.recipe import Recipe

    try:
        return Recipe.model_validate({"light": 0.6} | settings_of(settings))
    except ValidationError as error:
        raise wrong_value(error) from None


def wrong_value(error: ValidationError) -> ConfigurationError:
    """The error of a value that a recipe refuses."""
    first = error.errors()[0]
    return ConfigurationError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}.")


def settings_of(settings: list[str]) -> dict[str, object]:
    """Values by name of `--set` options. Raises ConfigurationError."""
    values: dict[str, object] = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals:
            raise ConfigurationError(f"--set {setting} does not have the form NAME=VALUE.")
        try:
            values[name] = json.loads(value)
        except ValueError:
            values[name] = value
    return values


def _pack(arguments: Namespace) -> int:
    from rn_policy_cubes.training import pack

    packed = pack(arguments.out)
    packed.write(arguments.to)
    print(f"{arguments.to}: {arguments.to.stat().st_size / 1e6:.2f} MB, step {packed.card.step}")
    return 0


def _unpack(arguments: Namespace) -> int:
    from rn_policy_cubes.checkpoint import CONFIGURATION_FILE, unpack

    unpack(_packed(arguments.weights), arguments.directory)
    directory = arguments.directory
    print(f"{directory}: use it with --config {directory / CONFIGURATION_FILE}")
    return 0


def _packed(weights: Path | None) -> Packed:
    from rn_policy_cubes.packing import Packed
    from rn_policy_cubes.weights import shipped_weights

    return Packed.read(weights or shipped_weights())
