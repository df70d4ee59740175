"""The thread that repeats a step, and the bounded wait used everywhere."""

from __future__ import annotations

import logging
import threading
import time

import pytest

from roboneuron.errors import StateError
from roboneuron.supervisor import changes as changes_module
from roboneuron.supervisor.changes import Changes, Event, Lasting, Periodic

SOON_S = 20.0


def test_a_step_that_raises_is_logged_once_and_repeated(caplog: pytest.LogCaptureFixture) -> None:
    again = threading.Event()
    steps: list[int] = []

    def step() -> None:
        steps.append(threading.get_ident())
        if len(steps) > 2:
            again.set()
        raise ValueError("the look failed")

    thread = Periodic("looks", 0.01, step)
    thread.start()
    thread.start()
    assert again.wait(SOON_S)
    thread.close()
    assert len(set(steps)) == 1, "one thread, although it was started twice"
    assert [
        record.exc_text for record in caplog.records if "the look failed" in str(record.exc_text)
    ], caplog.text
    assert len(caplog.records) == 1
    assert not [t for t in threading.enumerate() if t.name == "looks"]


def test_the_first_step_does_not_wait_for_the_period() -> None:
    stepped = threading.Event()
    thread = Periodic("slow", 3600.0, stepped.set)
    thread.start()
    assert stepped.wait(SOON_S)
    thread.close()
    thread.close()


def test_a_step_may_end_its_own_thread(caplog: pytest.LogCaptureFixture) -> None:
    steps: list[Periodic] = []
    ended = threading.Event()

    def step() -> None:
        steps.append(thread)
        thread.close()
        ended.set()

    thread = Periodic("once", 0.001, step)
    with caplog.at_level(logging.ERROR):
        thread.start()
        assert ended.wait(SOON_S)
        thread.close()
    assert len(steps) == 1
    assert caplog.text == ""


def test_one_that_was_never_started_can_be_closed() -> None:
    Periodic("never", 0.01, lambda: None).close()


def test_a_wait_ends_with_the_fact_the_bound_or_the_check() -> None:
    changes = Changes()
    assert changes.wait_for(lambda: 7, 0.0) == 7
    assert changes.wait_for(lambda: None, 0.0) is None
    looks: list[int] = []

    def check() -> None:
        looks.append(1)
        if len(looks) == 3:
            raise StateError("cancelled")

    with pytest.raises(StateError, match="cancelled"):
        changes.wait_for(lambda: False, SOON_S, check)

    def fail() -> None:
        raise StateError("asked although the fact is there")

    assert changes.wait_for(lambda: True, SOON_S, fail)


def test_a_fact_lasts_since_the_first_look_that_found_it() -> None:
    lasting = Lasting()
    assert lasting.held_s(False) < 0.0
    first_s = lasting.held_s(True)
    started_s = time.monotonic()
    while time.monotonic() == started_s:
        pass
    assert first_s < lasting.held_s(True)
    assert lasting.held_s(False) < 0.0
    assert lasting.held_s(True) == first_s == 0.0, "the time before the break does not count"


def test_a_wait_takes_its_time_out_and_no_longer() -> None:
    looks: list[int] = []
    started_s = time.monotonic()
    assert Changes().wait_for(lambda: looks.append(1), 0.12) is None
    assert 0.12 <= time.monotonic() - started_s < SOON_S
    assert len(looks) < 50


def test_a_wait_that_has_used_up_its_time_looks_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    class Stopwatch:
        now_s = 0.0

        def monotonic(self) -> float:
            return self.now_s

    clock, looks = Stopwatch(), list[float]()
    monkeypatch.setattr(changes_module, "time", clock)

    def look() -> bool:
        looks.append(clock.now_s)
        clock.now_s += 0.5
        return False

    assert Changes().wait_for(look, 0.5) is None
    assert looks == [0.0]


def test_a_fact_that_nobody_announces_is_found() -> None:
    started_s = time.monotonic()
    assert Changes().wait_for(lambda: time.monotonic() > started_s + 0.1, SOON_S)
    assert time.monotonic() - started_s < SOON_S / 2


@pytest.fixture
def no_polls(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(changes_module, "_POLL_S", 3600.0)


@pytest.mark.usefixtures("no_polls")
def test_a_change_wakes_all_who_wait() -> None:
    changes, facts, results = Changes(), list[str](), list[str | None]()
    looked = threading.Semaphore(0)

    def look() -> str | None:
        looked.release()
        return facts[0] if facts else None

    threads = [
        threading.Thread(target=lambda: results.append(changes.wait_for(look, SOON_S)), daemon=True)
        for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for _ in threads:
        assert looked.acquire(timeout=SOON_S)
    started_s = time.monotonic()
    facts.append("it is there")
    changes.notify()
    for thread in threads:
        thread.join(SOON_S)
    assert results == ["it is there"] * 2
    assert time.monotonic() - started_s < SOON_S / 2


@pytest.mark.usefixtures("no_polls")
def test_a_change_during_a_look_is_not_lost() -> None:
    changes, looks = Changes(), list[int]()

    def look() -> bool:
        looks.append(1)
        changes.notify()
        return len(looks) > 2

    started_s = time.monotonic()
    assert changes.wait_for(look, SOON_S)
    assert time.monotonic() - started_s < SOON_S / 2


@pytest.mark.usefixtures("no_polls")
def test_a_wait_without_changes_ends_with_its_time_out() -> None:
    started_s = time.monotonic()
    assert Changes().wait_for(lambda: False, 0.05) is None
    assert time.monotonic() - started_s < SOON_S / 2


def test_a_fact_may_be_zero_or_empty() -> None:
    assert Changes().wait_for(lambda: 0, 0.0) == 0
    assert Changes().wait_for(lambda: "", 0.0) == ""


def test_all_listeners_are_told_in_their_order_also_after_one_that_fails(
    caplog: pytest.LogCaptureFixture,
) -> None:
    event: Event[[int, str]] = Event()
    told: list[object] = []

    def fail(pid: int, name: str) -> None:
        raise ValueError("a broken listener")

    event.listen(lambda pid, name: told.append((pid, name)))
    event.listen(fail)
    event.listen(lambda pid, name: told.append(name))
    event.tell(7, name="arm")
    assert told == [(7, "arm"), "arm"]
    assert "a broken listener" in caplog.text
