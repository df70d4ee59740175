"""The robot module of RoboNeuron, the driver inside it and the stand-in controller: two processes
on one graph. How soon the arm rests after a stop, and after the module is killed, in the middle of
what was sent ahead.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip(
    "control_msgs", reason="control_msgs is not built here (it needs a C++ compiler)"
)

from ros2control_rig import ModuleRig, module_rig

from rn_testing.domain import free_ros_domain

pytestmark = pytest.mark.ros
ROW_S, SPEED_RAD_S, HORIZON_S = 0.05, 0.4, 0.5
ROWS = np.arange(1, 41) * ROW_S * SPEED_RAD_S
STOP_S = 0.5
"""From the emergency stop to the last motion, for each mode alike."""


class Rigs:
    """Makes rigs on a ROS domain of their own."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack

    def start(self, mode: str) -> ModuleRig:
        options = {"horizon_s": HORIZON_S} if mode == "chunks" else {}
        return self._stack.enter_context(module_rig(self._folder, mode=mode, **options))


@pytest.fixture
def rigs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rigs]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    with ExitStack() as stack:
        yield Rigs(tmp_path, stack)


def moving(rig: ModuleRig) -> float:
    """Wait until the arm is well under way; returns the monotonic time."""
    rig.send(ROWS, ROW_S)
    rig.wait_for(lambda: rig.measured[-1][1] > 0.1, "the motion")
    return time.monotonic()


@pytest.mark.parametrize("mode", ["topic", pytest.param("chunks", marks=pytest.mark.exhaustive)])
def test_a_trajectory_to_the_robot_module_moves_the_controller(rigs: Rigs, mode: str) -> None:
    rig = rigs.start(mode)
    rig.send([0.05, 0.1, 0.15, 0.2], 0.25)
    rig.wait_for(lambda: rig.reaches(0.2), "the motion")


@pytest.mark.timing  # test_driver_sends_chunks.py shows in one process that a hold beats a chunk
@pytest.mark.parametrize("mode", ["topic", "chunks"])
def test_an_emergency_stop_beats_what_was_sent_ahead(rigs: Rigs, mode: str) -> None:
    rig = rigs.start(mode)
    stopped_s = moving(rig)
    rig.stop()
    assert rig.rest_s(stopped_s) < STOP_S
    assert rig.measured[-1][1] < 0.1 + STOP_S * SPEED_RAD_S
    rig.send(ROWS, ROW_S)
    rested = rig.measured[-1][1]
    assert rig.rest_s(time.monotonic()) == 0.0
    assert rig.measured[-1][1] == pytest.approx(rested, abs=1e-5), "it moved without a new start"


@pytest.mark.parametrize("mode", ["topic", "chunks"])
def test_a_killed_driver_leaves_at_most_a_row_and_the_horizon(rigs: Rigs, mode: str) -> None:
    """Judged by the way that the arm goes on: the kill may block the controller's process, which
    then catches up in one step.
    """
    rig = rigs.start(mode)
    killed_s = moving(rig)
    killed_at = rig.measured[-1][1]
    rig.module.kill()
    rig.rest_s(killed_s)
    on_s = (rig.measured[-1][1] - killed_at) / SPEED_RAD_S
    ahead_s = HORIZON_S if mode == "chunks" else 0.0
    assert on_s < ROW_S + ahead_s + 0.2
    if mode == "chunks":
        assert on_s > ahead_s / 2, "nothing was sent ahead"
