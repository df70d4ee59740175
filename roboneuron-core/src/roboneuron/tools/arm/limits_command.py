"""The command `roboneuron limits`: show tightened limits, and loosen them by a person at a
terminal.
"""

from __future__ import annotations

import json
import sys
import time
from argparse import ArgumentParser, Namespace
from pathlib import Path


class Limits:
    """Show the limits that clients have tightened, and loosen them."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron limits`."""
        parser.add_argument(
            "--config",
            type=Path,
            metavar="FILE",
            help="a roboneuron.toml that names the state directory",
        )
        parser.add_argument(
            "--state", type=Path, metavar="DIRECTORY", help="the state directory itself"
        )
        parser.add_argument(
            "--robot", metavar="NAME", help="one of several robots; all of them without it"
        )
        parser.add_argument(
            "--loosen", action="store_true", help="return to the configured limits; asks for a yes"
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron limits`; exit status 1 if the person did not agree."""
        from roboneuron import foreign
        from roboneuron.config import reading
        from roboneuron.errors import ConfigurationError
        from roboneuron.ros import environment
        from roboneuron.tools.arm.tightening import FILE_NAME, TighteningFile

        configured = reading.read_state_directory(arguments.config) if arguments.config else None
        directory = environment.state_directory(
            str(arguments.state) if arguments.state else configured
        )
        of_robots = reading.robot_folder(directory).parent
        folders = (
            [of_robots / arguments.robot]
            if arguments.robot
            else [directory, *sorted(of_robots.glob("*"))]
        )
        files = [file for folder in folders if (file := folder / FILE_NAME).exists()]
        status = 0
        for path in files:
            file = TighteningFile(path)
            try:
                record = file.read()
            except ConfigurationError as error:
                if not arguments.loosen:
                    raise
                print(error.message)
            else:
                if record is None or record.tightening.is_empty:
                    continue
                tightened = json.dumps(record.tightening.model_dump(exclude_defaults=True))
                print(f"{path.parent}: {tightened}, by {foreign.printable(record.who)}")
            if arguments.loosen:
                status |= _loosen(file)
        if not files:
            print("No limits are tightened.")
        return status


def _loosen(file: object) -> int:
    """Ask the person at the terminal, then loosen; running servers notice within a second.

    Raises:
        RefusedError: there is no terminal, or neither file nor audit can be written.
    """
    from roboneuron.cli import terminal
    from roboneuron.errors import RefusedError
    from roboneuron.gate.audit import AuditLog, AuditRecord
    from roboneuron.gate.roles import Role
    from roboneuron.tools.arm.tightening import TightenedRecord, Tightening, TighteningFile

    assert isinstance(file, TighteningFile)
    if not sys.stdin.isatty():
        raise RefusedError(
            "Only a person in a terminal can loosen limits, and this is no terminal.",
            hint="Run the same command in a terminal (over ssh: `ssh -t`).",
            rule="person",
        )
    if not terminal.is_agreed("Return to the configured limits?"):
        print("They stay.")
        return 1
    who = AuditLog.user_at_terminal()
    audit = AuditLog.in_directory(file.path.parent)
    audit.write(AuditRecord(who=who, role=Role.ADMIN, tool="limits --loosen", verdict="loosened"))
    file.write(TightenedRecord(tightening=Tightening(), who=who, at_ns=time.time_ns()))
    print("Loosened.")
    return 0
