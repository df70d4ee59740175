"""Table of the parsers of data from outside: how many bad inputs each took, refused and let escape.

`python tools/parsers.py [INPUTS] [SEED]`, 300 inputs each without an argument. Exit status 1 if an
error escaped. The parsers are those of tests/test_parsers_*.py.
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from rn_testing.bad_data import ESCAPED, Parser, tried

TESTS = Path(__file__).parents[1] / "tests"


def parsers() -> Iterator[tuple[str, Parser]]:
    """All parsers by name."""
    for path in sorted(TESTS.glob("test_parsers_*.py")):
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield from module.PARSERS.items()


def main() -> int:
    """Print the table."""
    count, seed = (int(word) for word in [*sys.argv[1:3], "300", "5"][:2])
    print(f"{'parser':22} {'from':30} {'taken':>8} {'refused':>8} {'escaped':>8} {'s':>7}")
    status = 0
    for name, parser in parsers():
        begun_s = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            found = tried(parser, count, Path(folder), seed)
        escaped = {text: number for text, number in found.items() if text.startswith(ESCAPED)}
        print(
            f"{name:22} {parser.place:30} {found['taken']:8} {found['refused']:8} "
            f"{sum(escaped.values()):8} {time.monotonic() - begun_s:7.1f}",
            flush=True,
        )
        for text in escaped:
            status = 1
            print(f"    {text}")
    return status


if __name__ == "__main__":
    sys.exit(main())
