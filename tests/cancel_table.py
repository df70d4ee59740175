"""The table of cancelled calls: `make test-cancel` prints it whole."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

WhyNot = Callable[[str, str, str, str], str]
"""Transport, protocol, way, call -> why there is no such cell; empty if there is one."""


class Table:
    """Outcomes by transport and protocol, way, and call; and why a cell has none."""

    def __init__(self, calls: Iterable[str]) -> None:
        self._calls = tuple(calls)
        self._cells: dict[tuple[str, ...], str] = {}

    @contextmanager
    def cell(self, *cell: str) -> Iterator[Callable[[str], None]]:
        """A cell that has failed unless an outcome is given."""
        self._cells[cell] = "FAILED"

        def tell(outcome: str) -> None:
            self._cells[cell] = outcome

        yield tell

    def text(self, why_not: WhyNot) -> str:
        """The rows with outcomes, and the reasons why others have none."""
        reasons: dict[str, int] = {}
        lines = [f"{'':33}" + "".join(f"{call[:15]:>16}" for call in self._calls)]
        for row in dict.fromkeys(cell[:3] for cell in self._cells):
            line = f"{row[0]:6}{row[1]:12}{row[2]:15}"
            for call in self._calls:
                outcome = self._cells.get((*row, call), "")
                why = why_not(row[0], row[1], row[2], call)
                if not outcome and why:
                    outcome = f"({reasons.setdefault(why, len(reasons) + 1)})"
                line += f"{outcome or 'not run':>16}"
            lines.append(line)
        return "\n".join([*lines, *(f"({number}) {why}" for why, number in reasons.items())])


@contextmanager
def printed(table: Table, why_not: WhyNot) -> Iterator[Table]:
    """A table that is printed at the end; pytest shows it with -s."""
    yield table
    print(f"\n{table.text(why_not)}")
