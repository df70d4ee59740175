"""Several processes on each machine: all of the hub, and one of the member, use the link."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import pytest
from link_machines import Machine, Talker, impossible, machines
from link_pairs import pair

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]


def all_hear(*talkers: Talker) -> None:
    """Wait until each has heard all others, and itself."""
    for one, other in permutations(talkers, 2):
        wait_until(
            lambda one=one, other=other: min(one.heard(other.name), one.heard(one.name)) >= 5,
            30.0,
            f"{one.name} hears {other.name}",
        )


def with_port(gpu: Machine) -> Talker:
    """Start the process of the member that takes the port, as the first one does."""
    far = gpu.talk("far")
    wait_until(lambda: far.heard("far"), 30.0, "the process with the port")
    return far


@pytest.mark.parametrize("first", ["robot", "gpu"])
def test_processes_of_both_machines_hear_each_other(tmp_path: Path, first: str) -> None:
    with machines(tmp_path, "robot", "gpu") as made:
        robot, gpu = made["robot"], made["gpu"]
        pair(robot, gpu)
        if first == "gpu":
            far = with_port(gpu)
            all_hear(far, gpu.talk("local"))
        near = [robot.talk("camera"), robot.talk("control")]
        all_hear(*near)
        if first == "robot":
            far = with_port(gpu)
        local = gpu.talk("local-later")
        all_hear(*near, far)
        all_hear(far, local)
        assert [local.heard(one.name) for one in near] == [0, 0], "one process has the port"
