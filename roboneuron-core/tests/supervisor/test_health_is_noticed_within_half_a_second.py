"""The watch, judged by real processes that are frozen and killed, and the restart policy."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from roboneuron.config import Config
from roboneuron.supervisor.health import Report
from roboneuron.supervisor.restarts import Restarts
from roboneuron.supervisor.supervisor import Supervisor
from roboneuron.supervisor.view import ModuleView
from roboneuron.supervisor.watch import Health, Watch, assess

MakeConfig = Callable[..., Config]


class Diary:
    """Every change of health, with the monotonic time at which it was told."""

    def __init__(self) -> None:
        self.entries: list[tuple[float, str, Health]] = []
        self._changed = threading.Condition()

    def note(self, view: ModuleView, before: Health, health: Health) -> None:
        with self._changed:
            self.entries.append((time.monotonic(), view.kind, health))
            self._changed.notify_all()

    def wait_for(self, kind: str, *words: Health, since_s: float = 0.0, timeout_s: float = 5.0) -> float:
        """Time of the first such entry after `since_s`."""

        def found() -> float | None:
            return next((at for at, k, h in self.entries if at >= since_s and k == kind and h in words), None)

        with self._changed:
            assert self._changed.wait_for(lambda: found() is not None, timeout_s), (kind, words, self.entries)
        at = found()
        assert at is not None
        return at


@pytest.fixture
def diary(supervisor: Supervisor) -> Iterator[Diary]:
    made = Diary()
    watch = Watch(supervisor.views, [made.note])
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
def test_one_word_says_how_a_module_is(values: dict[str, float | str | bool], now_s: float, expected: str) -> None:
    assert assess(ModuleView(kind="robot", phase="running", report=report(**values)), now_s) == expected


@pytest.mark.ros
@pytest.mark.timeout(90)
def test_freezing_and_killing_are_noticed_within_half_a_second(
    supervisor: Supervisor, diary: Diary, make_config: MakeConfig
) -> None:
    process = supervisor.start("robot", make_config()).process
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


@pytest.fixture
def restarts(supervisor: Supervisor) -> Iterator[tuple[Restarts, list[str]]]:
    told: list[str] = []
    made = Restarts(supervisor, lambda kind, what: told.append(f"{kind}: {what}"))
    watch = Watch(supervisor.views, [made.on_health])
    watch.start()
    yield made, told
    made.close()
    watch.close()


def wait_until(fact: Callable[[], bool], timeout_s: float, what: str) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not fact():
        assert time.monotonic() < deadline_s, f"not within {timeout_s} s: {what}"
        threading.Event().wait(0.02)


def with_perception(config: Config, **rules: float) -> Config:
    from roboneuron.config import PerceptionConfig

    supervision = config.supervisor.model_copy(update={"restart_backoff_s": 0.1, "unresponsive_s": 0.6} | rules)
    return config.model_copy(update={"perception": PerceptionConfig(source="fake"), "supervisor": supervision})


@pytest.mark.ros
@pytest.mark.timeout(120)
def test_perception_comes_back_a_few_times_and_the_robot_does_not(
    supervisor: Supervisor, make_config: MakeConfig, restarts: tuple[Restarts, list[str]]
) -> None:
    _, told = restarts
    config = with_perception(make_config(), restart_limit=2)
    supervisor.start("robot", config)
    supervisor.start("perception", config)

    def pid(kind: str) -> int | None:
        view = supervisor.view(kind)  # type: ignore[arg-type]
        return view.process.pid if view.phase == "running" and view.process is not None else None

    first = pid("perception")
    assert first is not None
    os.kill(first, signal.SIGKILL)
    wait_until(lambda: pid("perception") not in (None, first), 20.0, "perception is back")
    second = pid("perception")
    assert second is not None
    os.kill(second, signal.SIGSTOP)
    wait_until(lambda: pid("perception") not in (None, second), 20.0, "a frozen one is replaced")
    third = pid("perception")
    assert third is not None
    robot = pid("robot")
    assert robot is not None
    for process in (third, robot):
        os.kill(process, signal.SIGKILL)
    wait_until(lambda: any("not restarted: 2 restarts" in text for text in told), 10.0, "the limit is told")
    assert supervisor.view("robot").phase == "exited"
    assert not any(text.startswith("robot") for text in told)


@pytest.mark.ros
@pytest.mark.timeout(60)
def test_a_stop_ends_a_pending_restart(
    supervisor: Supervisor, make_config: MakeConfig, restarts: tuple[Restarts, list[str]]
) -> None:
    made, told = restarts
    process = supervisor.start("perception", with_perception(make_config(), restart_backoff_s=2.0)).process
    assert process is not None
    process.kill()
    wait_until(lambda: made.cancel("perception"), 3.0, "a restart is pending")
    wait_until(lambda: not made.cancel("perception"), 3.0, "it is given up")
    assert supervisor.view("perception").phase == "exited"
    assert told == []
