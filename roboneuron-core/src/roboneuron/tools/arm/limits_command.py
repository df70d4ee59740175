"""The command `roboneuron robot limits`: show tightened limits, and loosen them by a person at a
terminal.
"""

from __future__ import annotations

import json
import sys
import time
from argparse import ArgumentParser, Namespace

from roboneuron.cli import state_folder


class Limits:
    """Show the limits that clients have tightened, and loosen them."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron robot limits`."""
        state_folder.add_arguments(parser)
        parser.add_argument(
            "--loosen", action="store_true", help="return to the configured limits; asks for a yes"
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron robot limits`; exit status 1 if the person did not agree, or a file
        cannot be read.

        Raises:
            ConfigurationError: the robot is unknown, or the file of --config cannot be read.
            RefusedError: there is no terminal for --loosen, or neither file nor audit can be
                written.
        """
        from roboneuron import foreign
        from roboneuron.errors import ConfigurationError
        from roboneuron.tools.arm.tightening import FILE_NAME, TighteningFile

        folders = state_folder.folders_of(arguments)
        files = [path for folder in folders if (path := folder / FILE_NAME).exists()]
        status = 0
        for path in files:
            file = TighteningFile(path)
            try:
                record = file.read()
            except ConfigurationError as error:
                print(error.message)
                status |= not arguments.loosen
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
