"""Threads that publish, take, call and create at once: none of them stops the others.

Fast DDS holds locks while it serialises; Python in there would be a deadlock sooner or later.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rn_interfaces.store import DefinitionStore
from rn_testing.domain import free_ros_domain

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]


def busy(seconds: float, domain: int) -> dict[str, int]:
    """What `busy_node.py` did."""
    script = Path(__file__).with_name("busy_node.py")
    ended = subprocess.run(
        [sys.executable, str(script), str(seconds)],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        capture_output=True,
        text=True,
        timeout=seconds + 120.0,
    )
    assert ended.returncode == 0, ended.stderr[-20_000:]
    return dict(ast.literal_eval(ended.stdout.splitlines()[-1]))


@pytest.mark.parametrize(
    "seconds",
    [
        2.0,
        pytest.param(5.0, marks=pytest.mark.exhaustive),
        pytest.param(60.0, marks=pytest.mark.slow),
    ],
)
def test_threads_that_share_entities_all_go_on(store: DefinitionStore, seconds: float) -> None:
    done = busy(seconds, free_ros_domain())
    assert len(done) == 5
    assert all(done.values()), done
