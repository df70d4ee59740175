"""Several processes on each machine: all hear all, whichever starts first."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import pytest
from link_machines import impossible, machines
from link_pairs import PORTS, pair

from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]


@pytest.mark.parametrize("first", ["robot", "gpu"])
def test_two_processes_of_each_machine_hear_all_others(tmp_path: Path, first: str) -> None:
    with machines(tmp_path, "robot", "gpu") as made:
        pair(made["robot"], made["gpu"])
        talkers = []
        for machine in sorted(made, key=lambda name: name != first):
            talkers += [made[machine].talk(f"{machine}-{number}") for number in range(2)]
            for talker in talkers:
                wait_until(lambda talker=talker: talker.heard(talker.name), 30.0, talker.name)
        for one, other in permutations(talkers, 2):
            wait_until(
                lambda one=one, other=other: one.heard(other.name) >= 5,
                30.0,
                f"{one.name} hears {other.name}",
            )
        assert len(PORTS.numbers) > 2, "ports without a process are tried in vain, and harm nobody"
