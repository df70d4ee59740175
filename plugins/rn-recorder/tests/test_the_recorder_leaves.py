"""The recorder's process ends, whatever its way out of ROS does."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rn_recorder_runs.settings import RecorderSettings, RulesSettings

SPINS_FOR_EVER = """
from rclpy.node import Node

def destroy_node(self):
    while True:
        pass

Node.destroy_node = destroy_node
from rn_recorder_runs.node import main
main()
"""


@pytest.mark.ros
def test_a_node_that_is_never_destroyed_does_not_keep_the_recorder(tmp_path: Path) -> None:
    settings = RecorderSettings(
        state_directory=tmp_path,
        directory=tmp_path / "runs",
        namespace="gantry",
        topics=(),
        exclude=(),
        images="jpeg",
        jpeg_quality=80,
        rules=RulesSettings(
            ring_s=30.0,
            after_s=0.5,
            part_bytes=10**8,
            part_s=600.0,
            quota_bytes=10**9,
            min_free_bytes=0,
        ),
        about={},
    )
    done = subprocess.run(
        [sys.executable, "-c", SPINS_FOR_EVER],
        input=settings.model_dump_json().encode() + b"\n",
        stdout=subprocess.DEVNULL,
        timeout=60,
        check=False,
    )
    assert done.returncode == -signal.SIGALRM
