"""Several processes on each machine: all of a domain discover each other, whichever starts
first.
"""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import pytest
from link_machines import Talker, impossible, machines
from link_pairs import pair

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]


def all_hear(*talkers: Talker) -> None:
    """Wait until each has received messages from all others and from itself."""
    for one, other in permutations(talkers, 2):
        wait_until(
            lambda one=one, other=other: min(one.heard(other.name), one.heard(one.name)) >= 5,
            30.0,
            f"{one.name} hears {other.name}",
        )


@pytest.mark.parametrize("first", ["robot", "gpu"])
def test_processes_of_both_machines_hear_each_other(tmp_path: Path, first: str) -> None:
    with machines(tmp_path, "robot", "gpu") as made:
        pair(made["robot"], made["gpu"])
        second = "gpu" if first == "robot" else "robot"
        talkers = [made[first].talk(f"{first}-{number}") for number in range(2)]
        all_hear(*talkers)
        talkers += [made[second].talk(f"{second}-{number}") for number in range(2)]
        all_hear(*talkers)


def test_another_process_keeps_the_relay_when_its_process_is_killed(tmp_path: Path) -> None:
    with machines(tmp_path, "robot", "gpu") as made:
        robot, gpu = made["robot"], made["gpu"]
        pair(robot, gpu)
        keeper = gpu.talk("keeper")
        wait_until(lambda: keeper.heard("keeper"), 30.0, "the process with the relay")
        near, far = robot.talk("near"), gpu.talk("far")
        all_hear(keeper, near, far)
        keeper.end()
        near.wait_for("far", 100, 30.0)
        far.wait_for("near", 100, 30.0)


def test_processes_of_other_domains_do_not_meet(tmp_path: Path) -> None:
    with machines(tmp_path, "robot", "gpu") as made:
        pair(made["robot"], made["gpu"])
        near = made["robot"].talk("near", ROS_DOMAIN_ID="7")
        same = made["gpu"].talk("same", ROS_DOMAIN_ID="7")
        other = made["gpu"].talk("other", ROS_DOMAIN_ID="8")
        all_hear(near, same)
        wait_until(lambda: other.heard("other") > 60, 30.0, "time to meet")
        assert (other.heard("near"), other.heard("same"), near.heard("other")) == (0, 0, 0)
