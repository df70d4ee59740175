"""A demo that fails on a slow machine says how slow it is; every other outcome is as it was."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from rn_standard.demo.pace import TOO_SLOW, MachinePace, core_share, run_paced
from roboneuron import ConfigurationError, NotReadyError

EXAMPLES = Path(__file__).parents[4] / "examples"
QUICK, SLOW = 0.95, 0.2
GROUP = ExceptionGroup("tasks", [NotReadyError("late"), ExceptionGroup("", [TimeoutError("over")])])
MIXED = ExceptionGroup("tasks", [NotReadyError("late"), KeyError("bug")])


def status(*factors: str) -> dict[str, object]:
    """An answer of get_status."""
    return {"modules": [{"module": "robot", "detail": {"real_time_factor": f}} for f in factors]}


@pytest.mark.parametrize(
    ("end", "factor", "share", "expected"),
    [
        (True, "1.000", QUICK, 0),
        (True, "0.400", SLOW, 0),
        (False, "1.000", QUICK, 1),
        (False, "0.000", QUICK, 1),  # before the first second is over
        (False, "0.400", QUICK, TOO_SLOW),
        (False, "1.000", SLOW, TOO_SLOW),
        (NotReadyError("late"), "0.400", QUICK, TOO_SLOW),
        (TimeoutError("over"), "1.000", SLOW, TOO_SLOW),
        (GROUP, "1.000", SLOW, TOO_SLOW),
        (NotReadyError("late"), "1.000", QUICK, NotReadyError),
        (GROUP, "1.000", QUICK, ExceptionGroup),
        (MIXED, "0.400", SLOW, ExceptionGroup),
        (KeyError("bug"), "0.400", SLOW, KeyError),
        (ConfigurationError("no such object"), "0.400", SLOW, ConfigurationError),
    ],
)
def test_the_exit_status_tells_failures_from_a_slow_machine(
    capsys: pytest.CaptureFixture[str],
    end: bool | Exception,
    factor: str,
    share: float,
    expected: int | type[Exception],
) -> None:
    async def play(pace: MachinePace) -> bool:
        pace.note(status(factor))
        if isinstance(end, Exception):
            raise end
        return end

    if isinstance(expected, type):
        with pytest.raises(expected):
            run_paced(play, lambda: share)
        return
    assert run_paced(play, lambda: share) == expected
    told = capsys.readouterr().err
    assert ("too slow" in told) == (expected == TOO_SLOW)
    if expected == TOO_SLOW:
        assert f"{max(float(factor), 0.0):.2f}" in told
        assert f"{share:.0%}" in told
    if isinstance(end, Exception) and expected == TOO_SLOW:
        assert "late" in told or "over" in told


def test_the_pace_is_the_usual_one_not_the_worst() -> None:
    pace = MachinePace(lambda: 1.0)
    pace.note(status("0.1"))
    pace.note(status("0.97", "1.0"))
    pace.note({"modules": [{"module": "control"}]})
    assert pace.factor == 0.97
    assert pace.complaint() == ""


def test_a_thread_gets_a_share_of_a_core() -> None:
    assert 0.0 < core_share() <= 1.0


@pytest.mark.parametrize("name", sorted(path.stem for path in EXAMPLES.glob("demo_*.py")))
def test_every_demo_has_this_exit_status(name: str) -> None:
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    assert any(way in text for way in ("run_paced(", "run_demo(", '"demo", "--config"'))


def test_the_command_says_so_in_its_help() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "roboneuron.cli.main", "demo", "--help"],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert str(TOO_SLOW) in done.stdout
