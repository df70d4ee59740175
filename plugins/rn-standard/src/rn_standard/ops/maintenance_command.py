"""The command `roboneuron robot maintenance`."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace

from roboneuron.command import state_folder


class Maintenance:
    """Take the robot out of service, put it back, or say whether it is (exit status 1 if it is out
    of service).

    Out of service the emergency stop is latched, and every call that acts is refused with who and
    why. Back in service the stop is still latched: release it as always.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron robot maintenance`."""
        state_folder.add_arguments(parser)
        action = parser.add_mutually_exclusive_group()
        action.add_argument("--begin", metavar="WHY", help="take it out of service")
        action.add_argument(
            "--end", action="store_true", help="put it back in service; asks for a yes"
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron robot maintenance`.

        Raises:
            ConfigurationError: the robot is unknown, or the file of --config cannot be read.
            RefusedError: there is no terminal for --end, or neither file nor audit can be written.
        """
        from rn_standard.ops.maintenance import MaintenanceFile
        from roboneuron import RefusedError
        from roboneuron.command import terminal
        from roboneuron.feature import AuditLog, Role, estop

        folders = state_folder.folders_of(arguments)
        if not arguments.robot:
            folders = folders[1:] or folders  # a server of several robots has none itself
        who, status = AuditLog.user_at_terminal(), 0
        if arguments.end and not sys.stdin.isatty():
            raise RefusedError(
                "Only a person in a terminal can put the robot back in service, and this is no "
                "terminal.",
                hint="Run the same command in a terminal (over ssh: `ssh -t`).",
                rule="person",
            )
        for folder in folders:
            file, audit = MaintenanceFile(folder), AuditLog.in_directory(folder)
            latch = estop.EmergencyStopLatch.in_directory(folder)
            if arguments.begin is not None:
                state = file.begin(who, Role.ADMIN, arguments.begin, audit)
                latch.latch(who=state.who, reason=f"maintenance: {state.reason}", audit=audit)
                print(f"{folder}: {state}. The emergency stop is latched.")
                continue
            found = file.read()
            print(f"{folder}: {found or 'in service'}")
            if found is None:
                continue
            if not arguments.end:
                status = 1
            elif terminal.is_agreed("Is everybody away from the robot? Back in service?"):
                file.end(who, Role.ADMIN, audit)
                print(f"In service. The emergency stop is latched: {latch.release_command}")
            else:
                status = 1
        return status
