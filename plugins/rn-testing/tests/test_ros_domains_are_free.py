"""A domain in which a process still claims a node is not given to a test."""

from __future__ import annotations

import socket
import sys

import pytest

from rn_testing import domain

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="abstract sockets are Linux' own: unix(7)"
)


def test_a_domain_with_a_node_that_a_killed_test_has_left_is_not_taken(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken = domain.free_ros_domain()
    monkeypatch.setattr(domain, "DOMAINS", [taken + 1000, taken + 2000])
    monkeypatch.setattr(domain, "_held", domain.deque())
    with socket.socket(socket.AF_UNIX) as left_over:
        left_over.bind(f"\0roboneuron/{taken + 1000}/fr3/control".encode())
        assert domain.free_ros_domain() == taken + 2000
