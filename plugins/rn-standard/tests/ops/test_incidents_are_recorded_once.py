"""The repetition of an incident is known whatever the wall clock is set to meanwhile."""

from __future__ import annotations

from pathlib import Path

from rn_standard.ops.incidents import Incidents

YEAR_S = 365 * 24 * 3600.0


def test_incidents_are_recorded_after_the_clock_was_set_back(tmp_path: Path) -> None:
    wall_s, monotonic_s = 1e9, 100.0
    incidents = Incidents(tmp_path, lambda: wall_s, lambda: monotonic_s)
    assert incidents.record("control", "stuck", {})
    assert incidents.record("control", "stuck", {}) is None
    wall_s -= YEAR_S
    monotonic_s += 10.0
    assert incidents.record("control", "stuck", {})
