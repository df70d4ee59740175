"""The contract case: a tiny random SmolVLA, created at run time with LeRobot's own classes."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from pathlib import Path

from rn_backend_lerobot.plugin import BACKEND
from rn_backend_lerobot.tiny import make_tiny
from rn_backend_lerobot.tiny_checkpoint import TinyShape
from rn_testing import BackendCase
from rn_testing.fakes import gantry_profile, make_observation
from roboneuron import robot_space

ROW_TOLERANCE = 0.02
"""Largest distance of guided rows from the committed ones [m, rad, opening]; without guidance it is
several `SPREAD`.
"""


def lerobot_case() -> BackendCase:
    """A SmolVLA that moves the fake robot of the contract kit; its folder is deleted when the
    process exits.
    """
    directory = Path(tempfile.mkdtemp(prefix="roboneuron-lerobot-"))
    atexit.register(shutil.rmtree, directory, ignore_errors=True)
    profile = gantry_profile()
    image = make_observation(BACKEND).frames["primary"].image
    joints = profile.arm_joints
    shape = TinyShape(
        cameras=("primary",),
        width=image.shape[1],
        height=image.shape[0],
        means=(*(0.0 for _ in joints), 0.5),
    )
    make_tiny(directory / "policy", "smolvla", shape)
    units = {"m": "metres", "rad": "radians", "opening": "open_fraction"}
    channels = {
        channel.name: {"to": channel.name, "unit": units[channel.unit]}
        for channel in robot_space("joint_position", profile).channels
    }
    options: dict[str, object] = {
        "checkpoint": str(directory / "policy"),
        "rate_hz": 10.0,
        "names": list(channels),
        "channels": channels,
        "device": "cpu",
        "threads": 1,
    }
    return BackendCase(spec=BACKEND, options=options, row_tolerance=ROW_TOLERANCE)
