"""The command `roboneuron-pi0`: create a tiny checkpoint, or check one without running it."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rn_backend_pi0.tiny_statistics import TINY_PROFILES
from roboneuron import MissingDependencyError, RoboNeuronError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns 0, or 1 after printing a failure; exits with 2 for wrong usage."""
    parser = argparse.ArgumentParser(prog="roboneuron-pi0", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    make = commands.add_parser(
        "make-tiny", help="write a tiny random checkpoint (0.3 MB), for trying things out"
    )
    make.add_argument("directory", type=Path, help="new or empty directory")
    make.add_argument(
        "--layout", choices=("lerobot", "openpi"), default="lerobot", help="default: %(default)s"
    )
    make.add_argument(
        "--variant", choices=("pi0", "pi05", "pi0_fast"), default="pi0", help="default: %(default)s"
    )
    make.add_argument(
        "--profile", choices=TINY_PROFILES, default="libero", help="default: %(default)s"
    )
    make.add_argument(
        "--seed", type=int, default=0, help="seed of the weights; default: %(default)s"
    )
    check = commands.add_parser(
        "check", help="compare a checkpoint's files with what the backend needs"
    )
    check.add_argument("directory", type=Path, help="LeRobot or openpi checkpoint")
    check.add_argument(
        "--asset-id", help="statistics to use from an openpi checkpoint that has several"
    )
    chosen = parser.parse_args(arguments)
    try:
        if chosen.command == "make-tiny":
            _make_tiny(chosen)
        else:
            _check(chosen.directory, chosen.asset_id)
    except RoboNeuronError as error:
        print(f"roboneuron-pi0: {error}", file=sys.stderr)
        return 1
    return 0


def _missing(error: ImportError) -> MissingDependencyError:
    return MissingDependencyError(
        f"{error.name} is not installed.", hint="Run: pip install torch safetensors tokenizers"
    )


def _make_tiny(chosen: argparse.Namespace) -> None:
    try:
        from rn_backend_pi0.tiny import make_tiny  # heavy
    except ImportError as error:
        raise _missing(error) from error
    make_tiny(
        chosen.directory,
        layout=chosen.layout,
        seed=chosen.seed,
        variant=chosen.variant,
        profile=chosen.profile,
    )
    backend = "pi0-fast" if chosen.variant == "pi0_fast" else "pi0"
    print(
        f"Wrote a tiny random {chosen.variant} checkpoint to {chosen.directory}. Use it as the "
        f"checkpoint of backend {backend!r}."
    )


def _check(directory: Path, asset_id: str | None) -> None:
    try:
        from rn_backend_pi0.weights import check_keys, open_shards  # heavy
    except ImportError as error:
        raise _missing(error) from error
    from rn_backend_pi0.layouts import read_checkpoint

    checkpoint = read_checkpoint(directory, asset_id=asset_id)
    with open_shards(directory) as shards:
        check_keys(
            {key: tuple(s.get_slice(full).get_shape()) for key, (s, full) in shards.items()},
            checkpoint.dims,
        )
        count = len(shards)
    print(f"family          {checkpoint.family}")
    print(f"variant         {checkpoint.dims.variant}")
    print(f"weights         {count} tensors, all accounted for")
    print(f"camera slots    {', '.join(checkpoint.slots)}")
    print(f"state, action   {checkpoint.state.width}, {checkpoint.action.width} values")
    print(
        f"chunk           {checkpoint.dims.chunk} actions, {checkpoint.denoising_steps} denoising "
        "steps"
    )
    print(f"profile         {checkpoint.profile or 'not said: set the option profile'}")


if __name__ == "__main__":
    sys.exit(main())
