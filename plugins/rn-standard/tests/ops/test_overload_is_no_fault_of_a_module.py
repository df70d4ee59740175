"""Restarts on a machine that is overloaded, judged with modules that only count their starts."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rn_standard.ops import restarts
from rn_standard.ops.options import OpsOptions
from rn_standard.ops.restarts import Restarts, runnable_per_core
from rn_testing.fakes import fake_plan
from roboneuron.config import parse_config
from roboneuron.errors import NotReadyError

BUSY, IDLE = 20.0, 0.1


class CountingModules:
    """Modules that end by themselves whenever they are started."""

    def __init__(self) -> None:
        self.started = 0
        self.refuses = False
        self.modules = self

    def view(self, kind: str) -> Any:
        return SimpleNamespace(phase="exited")

    def launch(self, selection: Any) -> None:
        self.started += 1
        if self.refuses:
            raise NotReadyError("No image came in time.")


def ended(kind: str = "perception") -> Any:
    """The view of a module that has ended by itself."""
    config = parse_config('[robot]\nname = "gantry"\n')
    plan = fake_plan(kind, config)  # type: ignore[arg-type]
    return SimpleNamespace(kind=kind, phase="exited", process=None, plan=plan)


class Rig:
    """Restarts of a machine with a chosen load."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **options: Any) -> None:
        self.load = IDLE
        self.modules = CountingModules()
        self.told: list[str] = []
        rules = OpsOptions.model_validate({"restart_backoff_s": 0.001, **options})
        monkeypatch.setattr(restarts, "_LOOK_S", 0.001)
        monkeypatch.setattr(restarts, "_LONGEST_S", 0.002)
        loop: Any = self.modules
        self.restarts = Restarts(loop, rules, self.record, load=lambda: self.load)

    def record(self, kind: str, what: str) -> None:
        self.told.append(what)

    def fail(self, times: int = 1) -> None:
        """The module ends; wait until that was dealt with."""
        for _ in range(times):
            self.restarts.on_health(ended(), "ok", "exited")
            for thread in threading.enumerate():
                if thread.name == "restart-perception":
                    thread.join(20.0)
                    assert not thread.is_alive()


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    return Rig(monkeypatch, restart_limit=3, overload_restart_limit=6)


def test_a_module_that_is_at_fault_is_given_up_with_what_to_do(rig: Rig) -> None:
    rig.fail(5)
    assert rig.modules.started == 3
    assert rig.told[-1] == (
        "not restarted: 3 restarts within 120 s; get_logs tells why. Mend the cause, then call "
        "start_perception"
    )


def test_an_overloaded_machine_does_not_use_up_the_restarts_of_a_fault(rig: Rig) -> None:
    rig.load = BUSY
    rig.fail(5)
    assert rig.modules.started == 5
    assert "the machine is overloaded" in rig.told[-1]
    assert "fewer cameras" in rig.told[-1]
    rig.load = IDLE
    rig.fail(5)
    assert rig.modules.started == 5 + 3


def test_restarts_on_an_overloaded_machine_end_too(rig: Rig) -> None:
    rig.load = BUSY
    rig.fail(9)
    assert rig.modules.started == 6
    assert rig.told[-1].startswith(
        "not restarted: 6 restarts within 3600 s; the machine is overloaded"
    )
    assert rig.told[-1].endswith("then call start_perception")


def test_starts_that_fail_under_load_are_tried_again_and_bounded(rig: Rig) -> None:
    rig.load, rig.modules.refuses = BUSY, True
    rig.fail()
    assert rig.modules.started == 6
    assert rig.told[:6] == ["restart failed: No image came in time."] * 6


def test_waits_under_load_grow_and_are_bounded(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restarts, "_LONGEST_S", 0.012)
    waits = [rig.restarts._delay_s("perception", BUSY) for _ in range(6)]
    assert waits == [0.002, 0.004, 0.008, 0.012, 0.012, 0.012]


def test_a_start_by_somebody_else_makes_the_counts_begin_anew(rig: Rig) -> None:
    rig.fail(4)
    rig.restarts.on_health(ended(), "exited", "starting")
    rig.fail(4)
    assert rig.modules.started == 3 + 3


@pytest.mark.parametrize(("load", "looks"), [(IDLE, 2), (BUSY, 10)])
def test_a_frozen_module_has_more_time_on_an_overloaded_machine(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, load: float, looks: int
) -> None:
    clock = iter(range(100))
    monkeypatch.setattr(
        restarts, "time", SimpleNamespace(monotonic=lambda: float(next(clock) // 2))
    )
    view = SimpleNamespace(kind="perception", process=None, health=lambda now_s: "silent")
    monkeypatch.setattr(rig.modules, "view", lambda kind: view)
    rig.load = load
    assert rig.restarts._is_still_frozen(view, threading.Event(), 2.0)  # type: ignore[arg-type]
    assert next(clock) // 2 == pytest.approx(looks, abs=1)


def test_the_load_is_what_runs_and_waits_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rn_standard.ops.restarts.cores", lambda: 2)
    file = tmp_path / "loadavg"
    file.write_text("0.10 0.20 0.30 9/512 4711\n")
    assert runnable_per_core(file) == 4.0
    file.write_text("nothing of the kind\n")
    assert runnable_per_core(file) == 0.0
    assert runnable_per_core(tmp_path / "absent") == 0.0
