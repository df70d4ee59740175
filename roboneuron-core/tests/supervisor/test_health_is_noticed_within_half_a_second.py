"""The watch, tested with real processes that are frozen and killed."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from rn_testing.fakes import fake_plan
from roboneuron.config import Config
from roboneuron.modules.report import Report
from roboneuron.modules.status import StatusWriter
from roboneuron.supervisor.health import Health, ModuleView, Watch
from roboneuron.supervisor.supervisor import Supervisor

MakeConfig = Callable[..., Config]


class Diary:
    """Every change of health, with the monotonic time of its notification."""

    def __init__(self) -> None:
        self.entries: list[tuple[float, str, Health]] = []
        self._changed = threading.Condition()

    def note(self, view: ModuleView, before: Health, health: Health) -> None:
        with self._changed:
            self.entries.append((time.monotonic(), view.kind, health))
            self._changed.notify_all()

    def wait_for(
        self, kind: str, *words: Health, since_s: float = 0.0, timeout_s: float = 5.0
    ) -> float:
        """Time of the first matching entry after `since_s`."""

        def found() -> float | None:
            return next(
                (at for at, k, h in self.entries if at >= since_s and k == kind and h in words),
                None,
            )

        with self._changed:
            assert self._changed.wait_for(lambda: found() is not None, timeout_s), (
                kind,
                words,
                self.entries,
            )
        at = found()
        assert at is not None
        return at


@pytest.fixture
def diary(supervisor: Supervisor) -> Iterator[Diary]:
    made = Diary()
    watch = Watch(supervisor.views, made.note)
    watch.start()
    yield made
    watch.close()


def report(**values: float | str | bool) -> Report:
    told = {"received_s": 100.0, "state": "active", "ready": True} | values
    return Report(**told)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("values", "now_s", "expected"),
    [
        ({}, 100.1, "ok"),
        ({}, 100.5, "silent"),
        ({"loop_age_s": 0.31}, 100.0, "stuck"),
        ({"work_age_s": 0.5, "work_limit_s": 0.4}, 100.0, "stalled"),
        ({"work_age_s": 0.5, "work_limit_s": 0.6}, 100.0, "ok"),
        ({"error_code": "internal"}, 100.0, "failing"),
        ({"ready": False}, 100.0, "waiting"),
    ],
)
def test_one_word_says_how_a_module_is(
    values: dict[str, float | str | bool], now_s: float, expected: str
) -> None:
    assert (
        ModuleView(kind="robot", phase="running", report=report(**values)).health(now_s) == expected
    )


@pytest.mark.parametrize("load", [0.0, 1000.0])
def test_an_overloaded_computer_is_no_reason_for_a_restart(
    load: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
    reason = ModuleView(kind="robot", phase="running", report=report()).still_reason(100.5)
    assert reason is not None
    assert reason.rule == "silent"
    assert ("load 1000" in reason.hint) == (load > 0)


def test_an_event_is_passed_on_once_and_the_next_process_counts_anew() -> None:
    reports: list[Report | None] = [None]
    told: list[tuple[object, ...]] = []
    watch = Watch(
        lambda: [ModuleView(kind="inference", phase="running", report=reports[-1])],
        lambda view, before, health: None,
        lambda *event: told.append(event),
    )
    status = StatusWriter("/toy/inference")
    for event in ("", "fallback", "fallback_over"):
        if event:
            status.tell(event, "late")
        reports.append(Report.from_values(status.report().to_values()))
        watch.look()
        watch.look()
    assert told == [
        ("inference", event, {"explanation": "late"}) for event in ("fallback", "fallback_over")
    ]
    reports.append(None)
    watch.look()
    reports.append(report(event="fallback", event_text="late", event_count=1))
    watch.look()
    assert len(told) == 3


@pytest.mark.ros
@pytest.mark.timing
@pytest.mark.timeout(90)
def test_freezing_and_killing_are_noticed_within_half_a_second(
    supervisor: Supervisor, diary: Diary, make_config: MakeConfig
) -> None:
    process = supervisor.start(fake_plan("robot", make_config())).process
    assert process is not None
    diary.wait_for("robot", "ok")
    noticed_s = []
    for _ in range(3):
        frozen_s = time.monotonic()
        os.kill(process.pid, signal.SIGSTOP)
        noticed_s.append(diary.wait_for("robot", "silent", since_s=frozen_s) - frozen_s)
        thawed_s = time.monotonic()
        os.kill(process.pid, signal.SIGCONT)
        diary.wait_for("robot", "ok", since_s=thawed_s)
    print(f"frozen: noticed after {noticed_s} s")
    assert sorted(noticed_s)[1] < 0.5, "the median: a machine may halt this process too"
    killed_s = time.monotonic()
    process.kill()
    took_s = diary.wait_for("robot", "exited", since_s=killed_s) - killed_s
    print(f"killed: noticed after {took_s * 1e3:.0f} ms")
    assert took_s < 0.5
