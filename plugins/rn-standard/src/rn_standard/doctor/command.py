"""The command `roboneuron doctor`."""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path

_MOST_TEXT = 1000


class Doctor:
    """Check whether this machine and a configuration are ready: Python, ROS, shared memory, images,
    plugins, GPU.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron doctor`."""
        parser.add_argument(
            "--config",
            type=Path,
            metavar="FILE",
            help="a roboneuron.toml; the embedded default without it",
        )
        parser.add_argument("--json", action="store_true", help="write the findings as JSON")

    def run(self, arguments: Namespace) -> int:
        """Run `roboneuron doctor`; exit status 1 if a check has failed."""
        import json

        from rn_standard.doctor.checks import run_checks
        from rn_standard.doctor.finding import Finding, Severity
        from roboneuron import foreign
        from roboneuron.command import load_config

        config = load_config(arguments.config)
        has_colour = sys.stdout.isatty() and "NO_COLOR" not in os.environ
        marks = {
            Severity.OK: ("✓", "32"),
            Severity.WARNING: ("!", "33"),
            Severity.FAILED: ("✗", "31"),
        }

        def show(finding: Finding) -> None:
            mark, colour = marks[finding.verdict]
            shown = foreign.printable(finding.text, _MOST_TEXT)
            print(f"\x1b[{colour}m{mark}\x1b[0m" if has_colour else mark, shown, flush=True)
            if finding.hint:
                print(f"    {foreign.printable(finding.hint, _MOST_TEXT)}", flush=True)

        found = []
        for check, finding in run_checks(config):
            found.append((check, finding))
            if not arguments.json:
                show(finding)
        if arguments.json:
            rows = [
                {
                    "id": c.id,
                    "question": c.question,
                    "verdict": f.verdict.value,
                    "text": f.text,
                    "hint": f.hint,
                }
                for c, f in found
            ]
            print(json.dumps({"findings": rows}, indent=2))
        return int(any(finding.verdict is Severity.FAILED for _, finding in found))
