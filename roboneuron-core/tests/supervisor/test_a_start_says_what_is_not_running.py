"""A module whose inputs have no publisher reports this after seconds, not after the start's
timeout.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from rn_testing.fakes import fake_plan
from roboneuron.config import Config
from roboneuron.errors import NotReadyError, StateError
from roboneuron.supervisor.slot import Phase
from roboneuron.supervisor.supervisor import Supervisor

MakeConfig = Callable[..., Config]


@pytest.mark.ros
@pytest.mark.timeout(90)
def test_a_backend_without_cameras_names_the_call_that_is_missing(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    started_s = time.monotonic()
    config = make_config(45.0, inference="never-ready")
    with pytest.raises(NotReadyError, match="not running: perception") as caught:
        supervisor.start(fake_plan("inference", config, "perception"))
    assert caught.value.hint == "Call start_perception first."
    assert time.monotonic() - started_s < 25.0
    assert supervisor.view("inference").phase == "stopped"


@pytest.mark.ros
@pytest.mark.timeout(90)
def test_what_is_being_started_is_waited_for(
    supervisor: Supervisor, make_config: MakeConfig
) -> None:
    config = make_config(12.0, inference="never-ready", perception="slow-configure")
    starting = threading.Thread(target=lambda: supervisor.start(fake_plan("perception", config)))
    starting.start()
    with pytest.raises(NotReadyError, match="was not ready within 12 s"):
        supervisor.start(fake_plan("inference", config, "perception"))
    starting.join(30.0)
    assert supervisor.view("perception").phase == "running"


def test_cameras_of_a_simulation_without_the_robot_name_the_call_at_once(
    tmp_path: Path, make_config: MakeConfig
) -> None:
    config = make_config(60.0)
    supervisor = Supervisor(tmp_path, command=lambda python: pytest.fail("nothing may be spawned"))
    started_s = time.monotonic()
    try:
        with pytest.raises(
            NotReadyError, match="come from the driver of the robot, which is not running"
        ) as caught:
            supervisor.start(fake_plan("perception", config, "robot"))
    finally:
        supervisor.close()
    assert caught.value.hint == "Call start_robot first."
    assert time.monotonic() - started_s < 20.0, "it was the whole time-out of 60 s"
    assert supervisor.view("perception").phase == "stopped"


@pytest.mark.parametrize(
    ("phase", "hint"),
    [("stopped", "Call it first."), ("starting", "wait for that"), ("stopping", "wait for that")],
)
def test_what_to_do_about_a_module_depends_on_what_happens_to_it(
    tmp_path: Path, phase: Phase, hint: str
) -> None:
    supervisor = Supervisor(tmp_path, command=lambda python: pytest.fail("nothing may be spawned"))
    try:
        slot = supervisor.slot("perception")
        slot.phase = phase
        with pytest.raises(StateError, match=f"perception is not running .it is {phase}") as caught:
            slot.check_running("Call it first.")
        assert hint in caught.value.hint
    finally:
        slot.phase = "stopped"
        supervisor.close()
