"""The command `roboneuron maintenance`."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from roboneuron.cli import terminal


class Maintenance:
    """Take the robot out of service, put it back, or say whether it is (exit status 1 if it is out
    of service).

    Out of service the emergency stop is latched, and every call that acts is refused with who and
    why. Back in service the stop is still latched: release it as always.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron maintenance`."""
        terminal.add_state_options(parser, "one of several robots")
        action = parser.add_mutually_exclusive_group()
        action.add_argument("--begin", metavar="WHY", help="take it out of service")
        action.add_argument(
            "--end", action="store_true", help="put it back in service; asks for a yes"
        )

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron maintenance`.

        Raises:
            RefusedError: there is no terminal for --end, or neither file nor audit can be written.
        """
        from rn_standard.ops.maintenance import MaintenanceFile
        from roboneuron.command import AuditLog, Role, estop
        from roboneuron.config import reading

        directory = terminal.chosen_state_directory(arguments)
        of_robots = reading.robot_folder(directory).parent
        folders = sorted(of_robots.glob("*")) or [directory]
        if arguments.robot:
            folders = [of_robots / arguments.robot]
        who, status = AuditLog.user_at_terminal(), 0
        if arguments.end:
            terminal.check_terminal("put the robot back in service")
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
