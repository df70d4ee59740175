"""What every test leaves as it found it."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings

from rn_testing.domain import free_ros_domain

settings.register_profile("busy-machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("busy-machine")


def pytest_configure(config: pytest.Config) -> None:
    """Give this process a ROS domain of its own: what runs side by side on one machine never meets.

    A worker of pytest-xdist inherits the domain of the process that distributes the tests, and so would its neighbour.
    """
    if hasattr(config, "workerinput") or "ROS_DOMAIN_ID" not in os.environ:
        os.environ["ROS_DOMAIN_ID"] = str(free_ros_domain())
    # A recorder beside every server would take a third of this machine; its own tests switch it on.
    os.environ["ROBONEURON_RECORDER"] = "off"


@pytest.fixture(autouse=True, scope="module")
def _pauses_of_the_interpreter() -> Iterator[None]:
    """Modules and servers freeze what they have loaded, since they live as long as their process; tests do not.

    Frozen ROS contexts are never collected: they keep their sockets, threads and shared memory.
    """
    interval_s = sys.getswitchinterval()
    yield
    sys.setswitchinterval(interval_s)
    gc.unfreeze()
    gc.collect()
