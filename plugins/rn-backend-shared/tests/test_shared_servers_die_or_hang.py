"""Shared server processes that die, hang, fail to load or lose their last robot."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from policy_servers import (
    SEEN,
    Robot,
    answers,
    seen,
    servers_in,
)

from rn_backend_shared.links import Links
from rn_testing.waiting import wait_until
from roboneuron import (
    CheckpointError,
    ConfigurationError,
    NotReadyError,
)

pytestmark = pytest.mark.timeout(200)


def test_a_server_that_dies_is_a_clear_error_and_then_there_is_another(
    spawned: Robot, tmp_path: Path
) -> None:
    one, other = spawned(), spawned()
    (pid,) = servers_in(tmp_path)
    os.kill(pid, signal.SIGKILL)
    with pytest.raises(NotReadyError, match="shared model"):
        one.predict(SEEN)
    wait_until(lambda: answers(one), 90.0, "another server answers")
    wait_until(lambda: answers(other), 90.0, "the other robot has found it too")
    wait_until(lambda: len(servers_in(tmp_path)) == 1, 90.0, "there is one of them")
    assert servers_in(tmp_path) != [pid]


@pytest.mark.slow
def test_with_a_replica_the_death_of_a_server_costs_no_more_than_the_chunk_under_way(
    spawned: Robot, tmp_path: Path
) -> None:
    one = spawned(replicas=2)
    wait_until(
        lambda: len(list((tmp_path / "run").glob("*.sock"))) == 2, 90.0, "both have a socket"
    )
    ready = Links(one._options)
    wait_until(lambda: all(ready._is_ready(path) for path in ready._paths), 90.0, "both are ready")
    ready.close()
    expected = one.predict(SEEN).actions
    told = one._links
    assert told is not None
    used = told._greet(told._paths[0])
    assert used is not None
    os.kill(used.pid, signal.SIGKILL)
    wait_until(lambda: used.pid not in servers_in(tmp_path), 90.0, "it is gone")
    lost = 0
    for _ in range(20):
        try:
            np.testing.assert_array_equal(one.predict(SEEN).actions, expected)
        except NotReadyError:
            lost += 1
    assert lost <= 1
    wait_until(lambda: len(servers_in(tmp_path)) == 2, 90.0, "it is replaced")


@pytest.mark.slow
def test_a_server_that_hangs_costs_no_more_than_the_deadline(
    spawned: Robot, tmp_path: Path
) -> None:
    one = spawned(timeout_s=0.3)
    (pid,) = servers_in(tmp_path)
    os.kill(pid, signal.SIGSTOP)
    try:
        with pytest.raises(NotReadyError, match="before the deadline"):
            one.predict(SEEN)
    finally:
        os.kill(pid, signal.SIGCONT)
    wait_until(lambda: answers(one), 90.0, "it goes on; the late answer is thrown away")
    expected = [one.predict(seen(index)).actions for index in (1, 2)]
    assert not np.array_equal(*expected)


def test_why_a_model_cannot_be_loaded_is_told_as_its_backend_says_it(served: Robot) -> None:
    with pytest.raises(CheckpointError, match=r"There are no weights\. Copy some"):
        served(options={"fails": True})
    with pytest.raises(ConfigurationError, match="'absent'"):
        served(backend="absent")


def test_a_server_without_robots_ends_and_leaves_no_socket(spawned: Robot, tmp_path: Path) -> None:
    one = spawned(idle_s=1.0)
    assert answers(one)
    one.close()
    wait_until(lambda: not servers_in(tmp_path), 90.0, "it ends")
    assert list((tmp_path / "run").glob("*.sock")) == []
