"""Detection of frozen processes, and the joint end of several.

The children are shells; no module and no ROS node is started.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from shells import SOON_S, Spawn, state_of

from rn_testing.waiting import wait_until
from roboneuron.errors import NotReadyError
from roboneuron.supervisor import changes as changes_module
from roboneuron.supervisor import process as process_module

pytestmark = pytest.mark.timeout(60)


class Clock:
    """A clock set by the test."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(changes_module, "time", clock)
    monkeypatch.setattr(process_module, "time", clock)
    return clock


@pytest.mark.parametrize(
    ("stat", "is_stopped"),
    [
        (b"7 (arm) T 1 7 7", True),
        (b"7 (arm) t 1 7 7", True),
        (b"7 (arm) S 1 7 7", False),
        (b"7 (arm) Z 1 7 7", False),
        (b"7 (arm) T 1) S 1 7 7", False),
        (b"7 (arm) S 1) T 1 7 7", True),
        (b"7 (\xffrm) T 1 7 7", True),
        (b"", False),
        (None, False),
    ],
)
def test_a_process_is_frozen_when_the_kernel_has_stopped_it_for_a_while(
    start: Spawn,
    clock: Clock,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stat: bytes | None,
    is_stopped: bool,
) -> None:
    process = start("cat")
    file = tmp_path / "stat"
    if stat is not None:
        file.write_bytes(stat)

    def find(path: str) -> Path:
        assert path == f"/proc/{process.pid}/stat"
        return file

    monkeypatch.setattr(process_module, "Path", find)
    assert not process.is_frozen(), "it may have been stopped a moment ago"
    clock.now_s += 0.3
    assert not process.is_frozen()
    clock.now_s += 0.001
    assert process.is_frozen() == is_stopped


def test_a_process_is_frozen_after_that_time_and_not_at_its_end(
    start: Spawn, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process_module, "_FROZEN_S", 0.25)
    process = start("cat")
    os.kill(process.pid, signal.SIGSTOP)
    wait_until(lambda: state_of(process.pid) == "T", SOON_S, "it runs")
    assert not process.is_frozen()
    clock.now_s += 0.25
    assert not process.is_frozen()


def test_a_process_that_goes_on_in_between_is_not_frozen(start: Spawn, clock: Clock) -> None:
    process = start("cat")
    os.kill(process.pid, signal.SIGSTOP)
    wait_until(lambda: state_of(process.pid) == "T", SOON_S, "it runs")
    assert not process.is_frozen()
    clock.now_s += 1.0
    assert process.is_frozen()
    os.kill(process.pid, signal.SIGCONT)
    wait_until(lambda: state_of(process.pid) != "T", SOON_S, "it is stopped")
    assert not process.is_frozen()
    os.kill(process.pid, signal.SIGSTOP)
    wait_until(lambda: state_of(process.pid) == "T", SOON_S, "it runs")
    assert not process.is_frozen(), "it counts from now on"


class Fake:
    """A process that ends this long after SIGTERM or SIGKILL, on a test clock."""

    def __init__(
        self,
        pid: int,
        clock: Clock,
        calls: list[tuple[Any, ...]],
        *,
        leaves_after_s: float = 0.0,
        dies_after_s: float = 0.0,
    ) -> None:
        self.pid, self.name = pid, f"module-{pid}"
        self._clock, self._calls = clock, calls
        self._leaves_after_s, self._dies_after_s = leaves_after_s, dies_after_s
        self._end_s = float("inf")

    def show(self) -> None:
        self._calls.append(("show", self.pid))

    def terminate(self) -> None:
        self._calls.append(("terminate", self.pid))
        self._end_s = self._clock.now_s + self._leaves_after_s

    def kill(self) -> None:
        self._calls.append(("kill", self.pid))
        self._end_s = self._clock.now_s + self._dies_after_s

    def wait(self, timeout_s: float) -> bool:
        self._calls.append(("wait", self.pid, round(timeout_s, 6)))
        until_s = min(self._end_s, self._clock.now_s + timeout_s)
        self._clock.now_s = max(self._clock.now_s, until_s)
        return self._end_s <= self._clock.now_s

    def leaves(self, timeout_s: float) -> bool:
        return self.wait(timeout_s)


def end(processes: Sequence[Fake], timeout_s: float) -> set[int]:
    return process_module.end_processes(processes, timeout_s)  # type: ignore[arg-type]


def test_all_are_told_to_leave_before_any_is_waited_for(clock: Clock) -> None:
    calls: list[tuple[Any, ...]] = []
    assert end([Fake(pid, clock, calls, leaves_after_s=0.5) for pid in (1, 2)], 3.0) == set()
    assert calls == [
        ("show", 1),
        ("terminate", 1),
        ("show", 2),
        ("terminate", 2),
        ("wait", 1, 3.0),
        ("wait", 2, 2.5),
        ("wait", 1, 5.0),
        ("wait", 2, 5.0),
    ]


def test_the_bound_holds_for_all_together(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    calls: list[tuple[Any, ...]] = []
    never = float("inf")
    processes = [
        Fake(1, clock, calls, leaves_after_s=never, dies_after_s=0.1),
        Fake(2, clock, calls, leaves_after_s=2.0),
        Fake(3, clock, calls, leaves_after_s=never),
    ]
    assert end(processes, 3.0) == {1, 3}
    assert [call for call in calls if call[0] == "wait"] == [
        ("wait", 1, 3.0),
        ("wait", 2, 0.0),
        ("wait", 3, 0.0),
        ("wait", 1, 5.0),
        ("wait", 2, 5.0),
        ("wait", 3, 5.0),
    ]
    assert [call for call in calls if call[0] == "kill"] == [("kill", 1), ("kill", 3)]
    assert clock.now_s == pytest.approx(103.1)
    assert "module-1 (pid 1) did not leave within 3 s" in caplog.text


def test_a_frozen_process_is_killed_without_a_wait_for_its_end(start: Spawn) -> None:
    frozen, ends = start("cat"), start("cat")
    os.kill(frozen.pid, signal.SIGSTOP)
    wait_until(lambda: state_of(frozen.pid) == "T", SOON_S, "it runs")
    begun_s = time.monotonic()
    assert process_module.end_processes([frozen, ends], 60.0) == {frozen.pid}
    assert time.monotonic() - begun_s < SOON_S
    assert (frozen.exit_code, ends.exit_code) == (-signal.SIGKILL, -signal.SIGTERM)


def test_no_process_gets_less_than_no_time_to_leave(clock: Clock) -> None:
    calls: list[tuple[Any, ...]] = []
    late = Fake(1, clock, calls)

    def terminate() -> None:
        clock.now_s += 1.0

    other = Fake(2, clock, calls)
    late.show = terminate  # type: ignore[method-assign]
    deadline_passed = Fake(3, clock, calls, leaves_after_s=9.0)
    wait = deadline_passed.wait

    def oversleep(timeout_s: float) -> bool:
        is_gone = wait(timeout_s)
        clock.now_s += 1.0
        return is_gone

    deadline_passed.leaves = oversleep  # type: ignore[method-assign]
    end([deadline_passed, late, other], 0.5)
    assert ("wait", 2, 0.0) in calls


def test_a_process_that_survives_sigkill_is_reported(clock: Clock) -> None:
    calls: list[tuple[Any, ...]] = []
    hangs = Fake(1, clock, calls, leaves_after_s=99.0, dies_after_s=5.001)
    with pytest.raises(NotReadyError, match=r"module-1 \(pid 1\) survives SIGKILL"):
        end([Fake(2, clock, calls), hangs], 1.0)
    assert ("kill", 2) not in calls
