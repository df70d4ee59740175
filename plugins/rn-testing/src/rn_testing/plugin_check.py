"""`roboneuron plugins check NAME`: checks the contract rules of an installed plugin, in a process
that may crash.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import dataclass

from rn_standard.console.chosen_plugins import add_config, find, read_disabled
from rn_standard.console.plugin_options import add_option, read_options
from roboneuron import ConfigurationError
from roboneuron.command import PLUGIN_KINDS, Status, discover
from roboneuron.feature import Registry

SCHEMA_VERSION = 1
"""Version of the JSON document; raised if a key changes its meaning or is removed."""
STYLES = {
    "passed": "green",
    "failed": "bold red",
    "skipped": "dim",
    "timeout": "bold red",
    "crashed": "bold red",
}
"""Colour of each verdict."""
WORKER = "rn_testing.check"
"""Module that runs the rules; never imported here."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckedRow:
    """One line of the table.

    Attributes:
        subject: the plugin, or kind and name of an offer.
        rule: the rule's id.
        text: the rule's text.
        verdict: "passed", "failed", "skipped"; "timeout" or "crashed" for the rule during which the
            process ended.
        detail: reason unless it passed.
        traceback: traceback of an unexpected exception.
    """

    subject: str
    rule: str
    text: str
    verdict: str
    detail: str = ""
    traceback: str = ""


class PluginsCheck:
    """Run the contract rules against an installed plugin, in a separate process."""

    def configure(self, parser: ArgumentParser) -> None:
        """Add the arguments of `roboneuron plugins check`."""
        parser.add_argument(
            "name", metavar="NAME", help="a plugin (rn-robot-fr3), a distribution or an offer (fr3)"
        )
        add_config(parser)
        parser.add_argument(
            "--kind", choices=sorted(PLUGIN_KINDS), help="check offers of this kind only"
        )
        add_option(parser, "all that is checked")
        parser.add_argument(
            "--max-s",
            type=float,
            default=120.0,
            metavar="SECONDS",
            help="time limit for the whole check (120)",
        )
        parser.add_argument("--json", action="store_true", help="machine-readable results")

    def run(self, arguments: Namespace) -> int:
        """Check, print the results, and return 0 if nothing failed."""
        return check(
            discover(read_disabled(arguments.config)),
            arguments.name,
            kind=arguments.kind,
            options=arguments.option,
            timeout_s=arguments.max_s,
            as_json=arguments.json,
        )


def check(
    registry: Registry,
    name: str,
    *,
    kind: str | None,
    options: Sequence[str],
    timeout_s: float,
    as_json: bool,
) -> int:
    """Check the rules for `name`, print the results, and return the exit status: 0 if nothing
    failed.

    Raises:
        ConfigurationError: nothing has that name, or an option is malformed or belongs to something
            else.
    """
    given = read_options(options, "")
    found = find(registry, name, kind)
    names = sorted({o.spec.name for _, offers in found for o in offers})
    for unknown in set(given) - {"", *names}:
        raise ConfigurationError(
            f"--option names {unknown!r}, which is not checked.",
            hint=f"Checked: {', '.join(names) or 'nothing'}.",
        )
    results: list[CheckedRow] = []
    for record, offers in found:
        usable = [o for o in offers if o.status is Status.READY]
        results += [
            CheckedRow(
                subject=f"{o.spec.kind} {o.spec.name}",
                rule="descriptor/ready",
                text="The offer can be used here.",
                verdict="skipped" if o.status is Status.UNAVAILABLE else "failed",
                detail=f"{o.status}: {o.reason}",
            )
            for o in offers
            if o.status is not Status.READY
        ]
        request = {
            "distribution": record.distribution,
            "plugin": record.name,
            "offers": [(o.spec.kind, o.spec.name) for o in usable],
            "options": given,
        }
        results += run_worker(json.dumps(request), timeout_s)
    if as_json:
        document = {"schema_version": SCHEMA_VERSION, "results": [_plain(r) for r in results]}
        print(json.dumps(document, indent=2))
    else:
        _print(results)
    return 0 if all(r.verdict in ("passed", "skipped") for r in results) else 1


def run_worker(request: str, timeout_s: float) -> list[CheckedRow]:
    """Run the worker in its own process group, and read its results up to its end or its kill."""
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8") as errors,
        # Folders of a case are removed with this one, even if the worker is killed. A thread that
        # the kill has not reached yet may still write.
        tempfile.TemporaryDirectory(
            prefix="roboneuron-check-", ignore_cleanup_errors=True
        ) as scratch,
    ):
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", WORKER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,
            # so that no file in the folder shadows a module
            env={**os.environ, "TMPDIR": scratch, "PYTHONSAFEPATH": "1"},
        )
        lost = ""
        try:
            output, _ = process.communicate(request, timeout=timeout_s)
        except subprocess.TimeoutExpired:
            lost = f"the whole check did not end within {timeout_s:g} s"
        finally:
            _end_group(process.pid)
        if lost:
            output, _ = process.communicate()
        errors.seek(0)
        complaint = errors.read()
    if not lost and process.returncode != 0:
        last = complaint.strip().splitlines()[-1:] or ["no message"]
        lost = f"the process ended with status {process.returncode}: {last[0]}"
    return read_results(output, lost, timed_out="did not end within" in lost)


def _end_group(group: int) -> None:
    """Kill the worker and all its children; the group may already be gone."""
    try:
        os.killpg(group, signal.SIGKILL)
    except ProcessLookupError:
        return


def read_results(output: str, lost: str, *, timed_out: bool) -> list[CheckedRow]:
    """Parse the worker's lines; the rule that was started but not decided gets the loss as its
    result, and so does the check if a line is broken.
    """
    results: list[CheckedRow] = []
    begun: dict[str, str] | None = None
    for line in output.splitlines():
        try:
            entry: dict[str, str] = json.loads(line)
            if "verdict" in entry:
                results.append(CheckedRow(**entry))
                begun = None
            else:
                begun = {key: entry[key] for key in ("subject", "rule", "text")}
        except (ValueError, TypeError, KeyError):
            lost = lost or f"a line of the check is broken: {line[:200]!r}"
    if begun is not None:
        lost = lost or "the process ended within this rule, without an error"
    if lost:
        place = begun or {
            "subject": "check",
            "rule": "check/completes",
            "text": "The check completes.",
        }
        results.append(
            CheckedRow(**place, verdict="timeout" if timed_out else "crashed", detail=lost)
        )
    return results


def _plain(result: CheckedRow) -> dict[str, str]:
    return {
        key: getattr(result, key)
        for key in ("subject", "rule", "text", "verdict", "detail", "traceback")
    }


def _print(results: Sequence[CheckedRow]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(highlight=False)
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in ("SUBJECT", "RULE", "VERDICT"):
        table.add_column(column, no_wrap=True)
    table.add_column("WHY", overflow="fold")
    for result in results:
        verdict = Text(result.verdict, style=STYLES[result.verdict])
        table.add_row(result.subject, result.rule, verdict, Text(result.detail))
    console.print(table)
    for result in results:
        if result.verdict not in ("passed", "skipped"):
            console.print(
                Text(
                    f"\n{result.subject}: {result.rule} {result.verdict}: {result.detail}",
                    style="red",
                )
            )
            console.print(Text(f"  rule: {result.text}"))
            if result.traceback:
                console.print(Text(result.traceback.rstrip(), style="dim"))
    counts = {verdict: sum(r.verdict == verdict for r in results) for verdict in STYLES}
    console.print(
        "\n" + ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    )
