"""The command `roboneuron policy cubes`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

from rn_policy_cubes.command_options import (
    add_computing,
    add_packing,
    add_settings,
    add_training,
    add_unpacking,
    data_of,
    say,
    told_settings,
    use_threads,
    values_checked,
)
from rn_policy_cubes.flow.command import configure_flow, run_flow
from rn_policy_cubes.monitor.command import configure_monitor, run_monitor
from roboneuron import ConfigurationError

if TYPE_CHECKING:
    from rn_policy_cubes.packing import Packed
    from rn_policy_cubes.recipe import Recipe

DEFAULT_DIRECTORY = Path("out/train-cubes")
IMPROVED_DIRECTORY = Path("out/improve-cubes")


class CubesPolicy:
    """A small learned policy for the suite "cubes": training, and export as a checkpoint in the
    OpenVLA-OFT layout, or, as a flow policy, in pi0's.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron policy cubes`."""
        actions = parser.add_subparsers(
            dest="action", required=True, metavar="ACTION", help="action to run"
        )
        train = actions.add_parser("train", help="make demonstrations and train, or continue")
        add_training(train, DEFAULT_DIRECTORY)
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
        add_packing(pack, DEFAULT_DIRECTORY)
        add_unpacking(
            actions.add_parser(
                "unpack", help="write a checkpoint that the backend oft-primary loads"
            )
        )
        configure_flow(actions.add_parser("flow", help="the same skill as a pi0 flow policy"))

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron policy cubes`."""
        match arguments.action:
            case "train":
                return _train(arguments)
            case "improve":
                return _improve(arguments)
            case "rollback":
                return _roll_back(arguments)
            case "monitor":
                return run_monitor(arguments)
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
    add("--max-s", type=float, default=30.0, metavar="S", help="of a scene [s] (default: 30)")
    add(
        "--margin",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="promote although it solves up to this share of the scenes fewer, unless the paired "
        "test finds that significant (default: 0)",
    )
    add_settings(parser, "rate=0.0005")
    add_computing(parser)


def _improve(arguments: Namespace) -> int:
    """Run the rounds; status 0 also if the champion stays."""
    use_threads(arguments.threads)
    from rn_policy_cubes.improvement_ledger import alone_in
    from rn_policy_cubes.improving import ELSEWHERE, RoundPlan, Wheel, recipe_of_round
    from rn_policy_cubes.weights import shipped_weights

    with values_checked():
        plan = RoundPlan(
            recipe=recipe_of_round(arguments.shards, arguments.steps, told_settings(arguments.set)),
            rollouts=arguments.rollouts,
            views=arguments.views,
            seeds=arguments.seeds,
            time_limit_s=arguments.max_s,
            suite_options=tuple(arguments.suite_option),
            margin=arguments.margin,
        )
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


def _roll_back(arguments: Namespace) -> int:
    from rn_policy_cubes.improvement_ledger import LEDGER_FILE, alone_in
    from rn_policy_cubes.improving import Wheel

    if not (arguments.out / LEDGER_FILE).exists():
        raise ConfigurationError(
            f"{arguments.out} holds no improved policy.",
            hint="Begin: roboneuron policy cubes improve",
        )
    with alone_in(arguments.out):
        wheel = Wheel(arguments.out, say)
        gone, back = wheel.roll_back()
        print(f"round {gone} is rolled back; the champion: {wheel.checkpoint(back)}")
    return 0


def _train(arguments: Namespace) -> int:
    use_threads(arguments.threads)
    from rn_policy_cubes.record import record
    from rn_policy_cubes.training import train

    recipe = _recipe(arguments.set)
    data = data_of(arguments)
    record(data, recipe.shards, workers=arguments.workers, say=say)
    training = train(
        recipe, arguments.out, data, until=arguments.until, fuse=arguments.fuse, say=say
    )
    print(f"step {training.step} of {recipe.steps}, state in {arguments.out}")
    return 0


def _recipe(settings: list[str]) -> Recipe:
    from rn_policy_cubes.recipe import Recipe

    with values_checked():
        return Recipe.model_validate({"light": 0.6} | told_settings(settings))


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
