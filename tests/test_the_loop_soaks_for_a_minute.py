"""`make soak` for one minute: random switches and faults, without growth."""

from __future__ import annotations

from pathlib import Path

import pytest
from soak import Settings, run

pytestmark = [pytest.mark.ros, pytest.mark.timing, pytest.mark.timeout(300)]


def test_a_minute_of_switches_and_faults_leaves_nothing_behind(tmp_path: Path) -> None:
    settings = Settings(
        duration_s=60.0, switch_s=20.0, fault_s=12.0, sample_s=2.0, warm_up_s=20.0, seed=5
    )
    report = run(settings, tmp_path, print)
    for trend in report.trends:
        print(
            f"{trend.process} {trend.quantity}: {trend.first:.1f} -> {trend.last:.1f}, fitted "
            f"{trend.growth:+.2f}"
        )
    assert report.problems == []
    assert len(report.outcomes) >= 4
    assert report.actions > 300
    assert {trend.process for trend in report.trends} == {
        "all",
        "server",
        "robot",
        "perception",
        "control",
        "inference",
    }
