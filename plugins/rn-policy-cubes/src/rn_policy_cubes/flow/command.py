"""The command `roboneuron policy cubes flow`: the same skill as a flow policy in pi0's layout."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from rn_policy_cubes.command_options import (
    add_packing,
    add_training,
    add_unpacking,
    data_of,
    say,
    told_settings,
    use_threads,
    values_checked,
)

FLOW_DIRECTORY = Path("out/train-flow")


def configure_flow(parser: ArgumentParser) -> None:
    """Add the arguments of `roboneuron policy cubes flow`."""
    actions = parser.add_subparsers(
        dest="flow_action", required=True, metavar="ACTION", help="action to run"
    )
    train = actions.add_parser("train", help="make demonstrations and train, or continue")
    add_training(train, FLOW_DIRECTORY)
    train.add_argument(
        "--more",
        type=int,
        action="append",
        default=[],
        metavar="NUMBER",
        help="number of a further shard in that folder, such as a rollout's; repeatable",
    )
    pack = actions.add_parser("pack", help="write the trained weights as one small file")
    add_packing(pack, FLOW_DIRECTORY)
    add_unpacking(
        actions.add_parser("unpack", help="write a checkpoint that the backend pi0 loads")
    )


def run_flow(arguments: Namespace) -> int:
    """Run `roboneuron policy cubes flow`."""
    match arguments.flow_action:
        case "train":
            return _train(arguments)
        case "pack":
            return _pack(arguments)
        case _:
            return _unpack(arguments)


def _train(arguments: Namespace) -> int:
    use_threads(arguments.threads)
    from rn_policy_cubes.flow.recipe import FlowRecipe
    from rn_policy_cubes.flow.training import train_flow
    from rn_policy_cubes.record import record

    with values_checked():
        recipe = FlowRecipe.model_validate(told_settings(arguments.set))
    data = data_of(arguments)
    record(data, recipe.shards, workers=arguments.workers, say=say)
    training = train_flow(
        recipe,
        arguments.out,
        data,
        more=arguments.more,
        until=arguments.until,
        fuse=arguments.fuse,
        say=say,
    )
    print(f"step {training.step} of {recipe.steps}, state in {arguments.out}")
    return 0


def _pack(arguments: Namespace) -> int:
    from rn_policy_cubes.flow.packing import pack_flow

    packed = pack_flow(arguments.out)
    packed.write(arguments.to)
    print(f"{arguments.to}: {arguments.to.stat().st_size / 1e6:.2f} MB, step {packed.card.step}")
    return 0


def _unpack(arguments: Namespace) -> int:
    from rn_policy_cubes.checkpoint import CONFIGURATION_FILE
    from rn_policy_cubes.flow.checkpoint import unpack_flow
    from rn_policy_cubes.flow.packing import FlowPacked
    from rn_policy_cubes.weights import shipped_flow_weights

    directory = arguments.directory
    unpack_flow(FlowPacked.read(arguments.weights or shipped_flow_weights()), directory)
    print(f"{directory}: use it with --config {directory / CONFIGURATION_FILE}")
    return 0
