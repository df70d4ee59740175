"""What pip would install on aarch64 (Jetson): every distribution resolved there, nothing installed.

`make aarch64` compares the table of docs/reference/aarch64.md with what the index has today; with
`ARGS=--write` it writes the table anew. `python tools/aarch64.py --sourced` prints the overrides of
uv that leave the ROS packages to a sourced installation.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "reference" / "aarch64.md"
PLATFORM, PYTHON = "aarch64-manylinux_2_28", "3.12"
_BEGIN, _END = "<!-- table: make aarch64 -->", "<!-- end of the table -->"
_WANTING = re.compile(
    r"([\w.-]+?)(?:[=<>!]=?[\w.+,<>=]+)? (?:has|have) no (?:usable wheels|wheels with a matching)"
)
_HEAD = "| distribution | wheels for aarch64 | third-party packages |\n|---|---|---|"
_FIRST = "| `{name}` | {verdict} | {packages} |"


def distributions() -> dict[str, Path]:
    """Folder of each distribution of this repository by name."""
    places = [*ROOT.glob("plugins/*/pyproject.toml"), ROOT / "roboneuron-core/pyproject.toml"]
    found = {
        str(_read(place)["name"]): place.parent for place in (*places, ROOT / "pyproject.toml")
    }
    return dict(sorted(found.items()))


def _read(place: Path) -> dict[str, object]:
    project: dict[str, object] = tomllib.loads(place.read_text(encoding="utf-8"))["project"]
    return project


def cases() -> Iterator[tuple[str, str]]:
    """Each distribution, and each extra of it but the one for its tests: name, and the extra or
    "".
    """
    for name, folder in distributions().items():
        yield name, ""
        extras = _read(folder / "pyproject.toml").get("optional-dependencies", {})
        assert isinstance(extras, dict)
        yield from ((name, extra) for extra in extras if extra != "testing")


def sourced_packages() -> list[str]:
    """Packages of ROS that a sourced installation has; the index has them for x86-64 only."""
    texts = [(f / "pyproject.toml").read_text(encoding="utf-8") for f in distributions().values()]
    return sorted(set(re.findall(r'^  "(ros-[a-z-]+)', "\n".join(texts), flags=re.MULTILINE)))


def overrides(names: Sequence[str]) -> str:
    """Lines for `--override` of uv that leave packages out."""
    return "".join(f"{name}; sys_platform == 'none'\n" for name in names)


def missing_wheels(error: str) -> list[str]:
    """Packages of which uv says that no wheel fits."""
    return list(dict.fromkeys(_WANTING.findall(" ".join(error.split()))))


def resolve(uv: str, name: str, extra: str, sourced: Sequence[str]) -> tuple[list[str], int]:
    """Packages without a wheel for the platform, and the number of the others that are not ours.

    Args:
        uv: the program.
        name, extra: see `cases`.
        sourced: packages that are there already.

    Raises:
        RuntimeError: it failed for another reason, such as an index that is not reached.
    """
    places = distributions()
    words = [uv, "pip", "compile", str(places[name] / "pyproject.toml")]
    words += ["--python-platform", PLATFORM, "--python-version", PYTHON, "--only-binary", ":all:"]
    words += ["--no-python-downloads", "--no-sources", "--no-annotate", "--no-header", "--quiet"]
    words += [*(("--extra", extra) if extra else ()), "--override"]
    ours = "".join(f"{one} @ {place.as_uri()}\n" for one, place in places.items())
    wanting: list[str] = []
    while True:
        left_out = overrides((*sourced, *wanting))
        with tempfile.TemporaryDirectory() as scratch:
            there = Path(scratch) / "overrides.txt"
            there.write_text(ours + left_out, encoding="utf-8")
            done = subprocess.run(
                [*words, str(there)], cwd=ROOT, capture_output=True, text=True, check=False
            )
        if done.returncode == 0:
            return sorted(wanting), sum("==" in line for line in done.stdout.splitlines())
        found = set(missing_wheels(done.stderr)) - {*wanting, *sourced}
        if not found:
            raise RuntimeError(f"{name}[{extra}] could not be resolved:\n{done.stderr}")
        wanting += found


def table(uv: str) -> str:
    """The table of the page."""
    sourced = sourced_packages()
    rows = [_HEAD]
    for name, extra in cases():
        wanting, count = resolve(uv, name, extra, sourced)
        shown = f"{name}[{extra}]" if extra else name
        row = _FIRST.format(
            name=shown, verdict=f"no: {', '.join(wanting)}" if wanting else "yes", packages=count
        )
        print(row, flush=True)
        rows.append(row)
    return "\n".join(rows)


def told() -> str:
    """The table as the page has it."""
    return PAGE.read_text(encoding="utf-8").partition(_BEGIN)[2].partition(_END)[0].strip()


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare or write the table; 1 if a verdict differs. The numbers of packages may differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--uv", default="uv", help="the program uv")
    parser.add_argument("--write", action="store_true", help="write the table into the page")
    parser.add_argument("--sourced", action="store_true", help="print the overrides and end")
    options = parser.parse_args(arguments)
    if options.sourced:
        print(overrides(sourced_packages()), end="")
        return 0
    found = table(options.uv)
    if options.write:
        before, _, rest = PAGE.read_text(encoding="utf-8").partition(_BEGIN)
        after = rest.partition(_END)[2]
        PAGE.write_text(f"{before}{_BEGIN}\n\n{found}\n\n{_END}{after}", encoding="utf-8")
        return 0
    changed = set(_verdicts(found)) ^ set(_verdicts(told()))
    for row in sorted(changed):
        print(f"differs from {PAGE.relative_to(ROOT)}: {row}", file=sys.stderr)
    return int(bool(changed))


def _verdicts(rows: str) -> list[str]:
    return [row.rpartition(" | ")[0] for row in rows.splitlines()]


if __name__ == "__main__":
    sys.exit(main())
