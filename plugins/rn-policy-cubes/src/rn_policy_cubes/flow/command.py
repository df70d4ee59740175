"""The command `roboneuron cubes-policy flow`: the same skill as a flow policy in pi0's layout."""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from pathlib import Path

FLOW_DIRECTORY = Path("out/train-flow")


def configure_flow(parser: ArgumentParser) -> None:
    """Add the arguments of `roboneuron cubes-policy flow`."""
    actions = parser.add_subparsers(
        dest="flow_action", required=True, metavar="ACTION", help="action to run"
    )
    train = actions.add_parser("train", help="make demonstrations and train, or continue")
    add = train.add_argument
    add("--out", type=Path, default=FLOW_DIRECTORY, help="default: %(default)s")
    add("--data", type=Path, help="folder of the demonstrations; default: OUT/demonstrations")
    add(
        "--more",
        type=int,
        action="append",
        default=[],
        metavar="NUMBER",
        help="number of a further shard in that folder, such as a rollout's; repeatable",
    )
    add(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="set a value of the recipe: steps=500",
    )
    add("--until", type=int, metavar="STEP", help="stop at this step, to continue later")
    add("--workers", type=int, default=1, help="processes that make demonstrations (default: 1)")
    add("--threads", type=int, default=1, help="threads of the training on a CPU (default: 1)")
    add("--fuse", action="store_true", help="compile the layers: half the time; needs C++")
    pack = actions.add_parser("pack", help="write the trained weights as one small file")
    pack.add_argument("--out", type=Path, default=FLOW_DIRECTORY, help="folder of the training")
    pack.add_argument("--to", type=Path, required=True, metavar="FILE", help="the packed file")
    unpack = actions.add_parser("unpack", help="write a checkpoint that the backend pi0 loads")
    unpack.add_argument("directory", type=Path, help="a new or empty folder")
    unpack.add_argument(
        "--weights", type=Path, help="a packed file; default: the one in this package"
    )


def run_flow(arguments: Namespace) -> int:
    """Run `roboneuron cubes-policy flow`."""
    match arguments.flow_action:
        case "train":
            return _train(arguments)
        case "pack":
            return _pack(arguments)
        case _:
            return _unpack(arguments)


def _train(arguments: Namespace) -> int:
    os.environ["OMP_NUM_THREADS"] = str(arguments.threads)
    import torch
    from pydantic import ValidationError

    from rn_policy_cubes.command import say, settings_of, wrong_value
    from rn_policy_cubes.flow.recipe import FlowRecipe
    from rn_policy_cubes.flow.training import train_flow
    from rn_policy_cubes.record import record

    try:
        recipe = FlowRecipe.model_validate(settings_of(arguments.set))
    except ValidationError as error:
        raise wrong_value(error) from None
    torch.set_num_threads(arguments.threads)
    data = arguments.data or arguments.out / "demonstrations"
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
