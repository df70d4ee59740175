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
    with pytest.raises(NotReadyError, match="policy server"):
        one.predict(SEEN)
    wait_until(lambda: answers(one), 90.0, "another server answers")
    wait_until(lambda: answers(other), 90.0, "the other robot has found it too")
    wait_until(lambda: len(servers_in(tmp_path)) == 1, 90.0, "there is one of them")
    assert servers_in(tmp_path) != [pid]


@pytest.mark.slow
def test_a_server_that_hangs_costs_no_more_than_the_deadline(
    spawned: Robot, tmp_path: Path
) -> None:
    one = spawned(timeout_s=0.3)
    (pid,) = servers_in(tmp_path)
    os.kill(pid, signal.SIGSTOP)
    try:
        with pytest.raises(NotReadyError, match="gave no answer"):
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


@pytest.mark.exhaustive
def test_a_server_without_robots_ends_and_leaves_no_socket(spawned: Robot, tmp_path: Path) -> None:
    one = spawned(idle_s=1.0)
    assert answers(one)
    one.close()
    wait_until(lambda: not servers_in(tmp_path), 90.0, "it ends")
    assert list((tmp_path / "run").glob("*.sock")) == []
