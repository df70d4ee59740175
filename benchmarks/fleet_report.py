"""Results of bench_fleet.py as a table, and the check of its bounds."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from dataclasses import dataclass, field

from fleet_bases import STEP_S, Base

MOST_STOP_MS, MOST_RATIO = 50.0, 1.10
ZERO_S = 5.0
"""Time after which a base without a stop command counts as not stopped."""


def lateness_ms(base: Base, split_ns: int) -> tuple[list[float], list[float]]:
    """Lateness of the first arrival of each number, before and after a given time."""
    first_at: dict[int, int] = {}
    for at_ns, x, number in base.arrivals():
        if x:
            first_at.setdefault(number, at_ns)
    before: list[float] = []
    after: list[float] = []
    for first, last in base.told:
        own = {
            n: at - (n - first) * STEP_S * 1e9 for n, at in first_at.items() if first <= n <= last
        }
        earliest = min(own.values(), default=0.0)
        for number, at in own.items():
            (before if first_at[number] < split_ns else after).append((at - earliest) / 1e6)
    return before, after


def percentile(values: list[float], share: float) -> float:
    """The smallest value that is not exceeded by this fraction of them."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


@dataclass
class Found:
    """Measurements."""

    stops_ms: list[float | None] = field(default_factory=list)
    victim: str = ""
    killed_ns: int = 0
    started_s: float = 0.0


def report(found: Found, bases: list[Base]) -> int:
    """Print the table; status 1 if a bound does not hold."""
    bad = _report_stops(found.stops_ms, len(bases))
    if not found.killed_ns:
        return int(bad)
    others = [base for base in bases if base.name != found.victim]
    sent = lost = messages = 0
    early: list[float] = []
    late: list[float] = []
    ratios: dict[str, float] = {}
    for base in others:
        numbers = {number for _, x, number in base.arrivals() if x}
        wanted = [n for first, last in base.told for n in range(first, last + 1)]
        sent, lost = sent + len(wanted), lost + sum(n not in numbers for n in wanted)
        messages += base.published
        before, after = lateness_ms(base, found.killed_ns)
        early, late = early + before, late + after
        if before and after:
            ratios[base.name] = percentile(after, 0.99) / percentile(before, 0.99)
    bad |= _report_commands(others, sent, lost, messages)
    return int(bad | _report_kill(found.victim, early, late, ratios))


def _report_commands(others: list[Base], sent: int, lost: int, messages: int) -> bool:
    print(f"robots                     {len(others)} (and one that is killed)")
    print(
        f"commands sent / lost       {sent} / {lost} (none allowed), {messages} messages with "
        "repetitions and stops"
    )
    failures = [f"  {base.name}: {failure}" for base in others for failure in base.failures]
    print("\n".join(failures[:5]) if failures else "calls that failed          0")
    return bool(failures) or lost > 0 or sent == 0


def _report_stops(stops_ms: list[float | None], robots: int) -> bool:
    if not stops_ms:
        return False
    times = [ms for ms in stops_ms if ms is not None]
    if not times:
        print("fleet stop                 no stop reached all robots")
        return True
    median = statistics.median(times)
    print(
        f"fleet stop -> last stands  median {median:.1f} ms of {len(times)}, p95 "
        f"{percentile(times, 0.95):.1f}, "
        f"worst {max(times):.1f}; {robots} robots (median at most {MOST_STOP_MS:g})"
    )
    if len(times) < len(stops_ms):
        print(
            f"  in {len(stops_ms) - len(times)} stops some base was not told to stand within "
            f"{ZERO_S:g} s"
        )
    return median > MOST_STOP_MS or len(times) < len(stops_ms)


def _report_kill(
    victim: str, early: list[float], late: list[float], ratios: Mapping[str, float]
) -> bool:
    if not early or not late:
        print("lateness                   no commands before or after the kill")
        return True
    before, after = percentile(early, 0.99), percentile(late, 0.99)
    ratio = after / before
    print(
        f"lateness p50 before/after  {statistics.median(early):.2f} / "
        f"{statistics.median(late):.2f} ms"
    )
    print(
        f"lateness p99 before/after  {before:.2f} / {after:.2f} ms, ratio {ratio:.2f} (at most "
        f"{MOST_RATIO})"
    )
    print(
        f"  by robot: median of the ratios {statistics.median(ratios.values()):.2f}, largest "
        f"{max(ratios.values()):.2f}; {victim} was killed"
    )
    return ratio > MOST_RATIO
