"""`roboneuron-oft`: tiny checkpoints to try the backend with."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from roboneuron.errors import RoboNeuronError


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    parser = argparse.ArgumentParser(prog="roboneuron-oft", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser("make-tiny", help="write a tiny random OpenVLA-OFT checkpoint in the public layout")
    make.add_argument("directory", type=Path, help="new or empty directory")
    make.add_argument("--seed", type=int, default=0, help="of the random weights (default 0)")
    options = parser.parse_args(arguments)
    from rn_backend_oft.tiny import make_tiny_oft  # heavy: torch
    from rn_backend_openvla.tiny import STATISTICS_KEY

    try:
        make_tiny_oft(options.directory, seed=options.seed)
    except RoboNeuronError as error:
        print(f"roboneuron-oft: {error}", file=sys.stderr)
        return 2
    print(f'Wrote {options.directory}: checkpoint = "{options.directory}", unnorm_key = "{STATISTICS_KEY}".')
    print('Its actions are random; use it with profile = "libero", constants = "libero", proprio = true.')
    return 0
