"""The command of a package for OpenVLA checkpoints: `make-tiny`, which creates a checkpoint to try
its backend with.
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
        program: name of the command.
        model: name of the model for people.
        options: options to use it with; "{}" stands for the platform.
        load: imports and returns the writer for one of `platforms`; called after the arguments are
            parsed, so that `--help` is fast.
        platforms: values of `--constants`, the default first; a single empty name without this
            option.
    """

    program: str
    model: str
    options: str
    load: Callable[[str], MakeTiny]
    platforms: tuple[str, ...] = ("",)

    def run(self, arguments: Sequence[str] | None = None) -> int:
        """Run the command with these arguments (sys.argv if None); returns the exit status."""
        description = f"`{self.program}`: tiny checkpoints to try the backend with."
        parser = argparse.ArgumentParser(prog=self.program, description=description)
        commands = parser.add_subparsers(dest="command", required=True)
        make = commands.add_parser(
            "make-tiny", help=f"write a tiny random {self.model} checkpoint in the public layout"
        )
        make.add_argument("directory", type=Path, help="new or empty directory")
        make.add_argument(
            "--seed", type=int, default=0, help="seed of the random weights (default 0)"
        )
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
