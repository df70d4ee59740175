"""The command `roboneuron-lerobot`: creates tiny checkpoints to try the backend with."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rn_backend_lerobot.tiny import PATCHED, POLICIES, make_tiny
from rn_backend_lerobot.tiny_checkpoint import TinyShape
from roboneuron import RoboNeuronError

PROGRAM = "roboneuron-lerobot"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command with these arguments (sys.argv if None); returns the exit status."""
    parser = argparse.ArgumentParser(
        prog=PROGRAM, description=f"`{PROGRAM}`: tiny checkpoints to try the backend with."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser(
        "make-tiny", help="write a tiny random checkpoint with LeRobot's own classes"
    )
    make.add_argument("directory", type=Path, help="new or empty directory")
    make.add_argument("--policy", choices=POLICIES, default="act", help="default: act")
    make.add_argument("--seed", type=int, default=0, help="of the random weights (default 0)")
    make.add_argument(
        "--cameras", default="front,wrist", help="image features, by commas (default front,wrist)"
    )
    make.add_argument("--size", default="96x96", help="of the images, WIDTHxHEIGHT [px]")
    given = parser.parse_args(arguments)
    width, _, height = given.size.partition("x")
    if not (width.isdigit() and height.isdigit()):
        parser.error(f"--size is {given.size!r}, expected WIDTHxHEIGHT, for instance 640x480")
    shape = TinyShape(cameras=given.cameras.split(","), width=int(width), height=int(height))
    try:
        make_tiny(given.directory, given.policy, shape, seed=given.seed)
    except RoboNeuronError as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return 2
    print(f'Wrote {given.directory}: checkpoint = "{given.directory}".')
    if given.policy in PATCHED:
        print("Its sizes are patched: only rn_backend_lerobot.small_gemma can load it.")
    else:
        print('Its state and action are seven joints [rad] and a gripper ("open_fraction").')
    return 0


if __name__ == "__main__":
    sys.exit(main())
