"""The command that a package of OpenVLA checkpoints brings: `make-tiny`, a checkpoint to try its
backend with.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from roboneuron import RoboNeuronError


class MakeTiny(Protocol):
    """Writes a checkpoint of random weights into a new or empty directory."""

    def __call__(self, path: Path, /, *, seed: int) -> None:
        """Raises ConfigurationError when the directory is not empty."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class TinyCommand:
    """One package's command.

    Attributes:
        program: its name.
        model: what the checkpoint is of, as people call it.
        options: what to use it with; "{}" stands for the platform.
        load: imports and returns what writes it, for one of `platforms`; called once the arguments
            are parsed, so that `--help` is quick.
        platforms: what `--constants` may name, the default first; none without such an option.
    """

    program: str
    model: str
    options: str
    load: Callable[[str], MakeTiny]
    platforms: tuple[str, ...] = ("",)

    def run(self, arguments: Sequence[str] | None = None) -> int:
        """Parse the arguments (those of the process when None) and do it; returns the exit
        status.
        """
        description = f"`{self.program}`: tiny checkpoints to try the backend with."
        parser = argparse.ArgumentParser(prog=self.program, description=description)
        commands = parser.add_subparsers(dest="command", required=True)
        make = commands.add_parser(
            "make-tiny", help=f"write a tiny random {self.model} checkpoint in the public layout"
        )
        make.add_argument("directory", type=Path, help="new or empty directory")
        make.add_argument("--seed", type=int, default=0, help="of the random weights (default 0)")
        if len(self.platforms) > 1:
            make.add_argument(
                "--constants",
                choices=self.platforms,
                default=self.platforms[0],
                help="platform whose chunk, widths and state it has (default %(default)s)",
            )
        else:
            make.set_defaults(constants=self.platforms[0])
        given = parser.parse_args(arguments)
        from rn_vla.openvla.tiny import STATISTICS_KEY

        try:
            self.load(given.constants)(given.directory, seed=given.seed)
        except RoboNeuronError as error:
            print(f"{self.program}: {error}", file=sys.stderr)
            return 2
        print(
            f'Wrote {given.directory}: checkpoint = "{given.directory}", unnorm_key = '
            f'"{STATISTICS_KEY}".'
        )
        options = self.options.format(given.constants)
        print(f"Its actions are random; use it with {options}.")
        return 0
