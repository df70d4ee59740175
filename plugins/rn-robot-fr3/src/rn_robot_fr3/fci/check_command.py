"""The command `roboneuron robot fr3`."""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from pathlib import Path

_MARKS = {"ok": "✓", "warning": "!", "failed": "✗"}


class Fr3:
    """Check whether this machine and its network can control a real Franka Research 3."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron robot fr3`."""
        actions = parser.add_subparsers(
            dest="action", required=True, metavar="ACTION", help="what to do"
        )
        check = actions.add_parser(
            "check",
            help="test network and kernel against limits; moves nothing, exit status 1 when "
            "something failed",
        )
        check.add_argument(
            "host",
            nargs="?",
            help="address of the control box; without one only the machine is tested",
        )
        check.add_argument(
            "--seconds", type=float, default=5.0, help="of each measurement (default: %(default)s)"
        )
        check.add_argument("--json", action="store_true", help="write the findings as JSON")

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron robot fr3 check`."""
        from rn_robot_fr3.fci.check import SystemFiles, check_machine
        from rn_robot_fr3.fci.network_check import check_network

        machine = SystemFiles(Path("/"))
        findings = check_machine(machine, arguments.seconds)
        if arguments.host:
            findings += check_network(machine, arguments.host, arguments.seconds)
        if arguments.json:
            json.dump([asdict(finding) for finding in findings], sys.stdout, indent=2)
            print()
        else:
            for finding in findings:
                print(f"{_MARKS[finding.verdict]} {finding.name}: {finding.found}")
                if finding.verdict != "ok":
                    print(f"    {finding.hint}")
        failed = [finding.name for finding in findings if finding.verdict == "failed"]
        if not arguments.json:
            print(
                f"Not fit for a real arm: {', '.join(failed)}."
                if failed
                else "Nothing speaks against a real arm."
            )
        return 1 if failed else 0
