"""Results of the mutants of a part, and the check whether they suffice."""

from __future__ import annotations

import os
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mutation_identity import describe_change
from mutation_parts import ROOT, Part
from mutmut.mutation.data import MutantLineSpans, SourceFileMutationData
from mutmut.stats import status_by_exit_code

SURVIVORS = ROOT / "tools" / "mutation_survivors.toml"
LEAST_PERCENT = 95.0
NOT_RUN = 255
"""Exit code of mutmut if pytest refuses to run, for example because a test is not found; mutmut
reports it as a timeout.
"""
UNKNOWN = ("not checked", "check was interrupted by user")


@dataclass(frozen=True, kw_only=True, slots=True)
class Mutant:
    """One mutant.

    Attributes:
        file: relative to the package.
        function: its name, with the class.
        change: the statement before and after, see `describe_change`; numbered if the function has
            the same change twice.
        status: mutmut's status: "killed", "timeout", "survived", "no tests", "not checked" and
            others; or "not run".
    """

    file: str
    function: str
    change: str
    status: str

    @property
    def is_killed(self) -> bool:
        """True if a test detected it, or timed out."""
        return self.status in ("killed", "timeout", "segfault", "suspicious")


def read_mutants(part: Part, work: Path) -> Iterator[Mutant]:
    """Known results of a part."""
    if not (work / "mutants").is_dir():
        return
    os.chdir(work)
    package = Path("src") / Path(part.package).name
    for meta in sorted((work / "mutants" / package).rglob("*.py.meta")):
        path = package / meta.relative_to(work / "mutants" / package).with_suffix("")
        data = SourceFileMutationData(path=path)
        data.load()
        spans = MutantLineSpans.load(path)
        if spans is None:
            continue
        file = str(path.relative_to(package))
        wanted = part.functions.get(file)
        changes = Counter[tuple[str, str]]()
        for key, code in data.exit_code_by_key.items():
            name = key.rpartition(".")[2]
            base = name.rpartition("__mutmut_")[0]
            function = base.removeprefix("x_").removeprefix("xǁ").replace("ǁ", ".")
            if wanted is not None and function.rpartition(".")[2] not in wanted:
                continue
            before, after = spans.read_function_sources([f"{base}__mutmut_orig", name])
            before, after = (
                before.replace(f"{base}__mutmut_orig", base, 1),
                after.replace(name, base, 1),
            )
            change = describe_change(before, after)
            changes[function, change] += 1
            number = changes[function, change]
            yield Mutant(
                file=file,
                function=function,
                change=change if number == 1 else f"{change} [{number}]",
                status="not run" if code == NOT_RUN else status_by_exit_code[code],
            )


def print_report(name: str, mutants: list[Mutant]) -> bool:
    """Print a part's figures and survivors; return whether the part passes."""
    listed = _listed(name)
    print(
        f"\n{name:32}{'mutants':>9}{'killed':>8}{'by time':>9}{'survived':>10}"
        f"{'no test':>9}{'equivalent':>12}{'%':>8}"
    )
    files = sorted({mutant.file for mutant in mutants})
    for file in files:
        _print_row(file, [mutant for mutant in mutants if mutant.file == file], listed)
    percent = _print_row("all", mutants, listed)
    left = [mutant for mutant in mutants if not mutant.is_killed]
    unlisted = [
        mutant for mutant in left if (mutant.file, mutant.function, mutant.change) not in listed
    ]
    for mutant in unlisted:
        if mutant.status in UNKNOWN:
            continue
        print(f"{mutant.file}: {mutant.function}: {mutant.change}  ({mutant.status})")
    known = {(mutant.file, mutant.function, mutant.change) for mutant in left}
    for file, function, change in sorted(set(listed) - known):
        print(f"listed, but it does not survive: {file}: {function}: {change}")
    print(
        f"{name}: {percent:.1f} % of what is not equivalent, at least {LEAST_PERCENT:g} %; "
        f"{len(unlisted)} unlisted"
    )
    return bool(mutants) and not unlisted and percent >= LEAST_PERCENT


def _print_row(title: str, mutants: list[Mutant], listed: dict[tuple[str, str, str], str]) -> float:
    statuses = Counter(mutant.status for mutant in mutants)
    equivalent = sum(
        listed.get((mutant.file, mutant.function, mutant.change)) == "equivalent"
        and not mutant.is_killed
        for mutant in mutants
    )
    killed = sum(mutant.is_killed for mutant in mutants)
    percent = 100.0 * killed / max(1, len(mutants) - equivalent)
    unknown = sum(statuses[status] for status in UNKNOWN)
    print(
        f"  {title:30}{len(mutants):9}{killed:8}{statuses['timeout']:9}{statuses['survived']:10}"
        f"{statuses['no tests']:9}{equivalent:12}{percent:8.1f}"
        + (f"  ({unknown} not tried)" if unknown else "")
    )
    return percent


def _listed(part: str) -> dict[tuple[str, str, str], str]:
    """Listed survivors of a part: file, function and change; "equivalent" or "accepted"."""
    entries = tomllib.loads(SURVIVORS.read_text("utf-8")).get("survivor", [])
    for entry in entries:
        if entry["kind"] not in ("equivalent", "accepted") or not entry["reason"]:
            sys.exit(
                f"{SURVIVORS.name}: kind {entry['kind']!r} of {entry['function']} is neither, or "
                "no reason is given."
            )
    return {
        (e["file"], e["function"], e["change"]): e["kind"] for e in entries if e["part"] == part
    }
