"""Control space of a configured pi0's chunks, determined before anything is loaded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rn_backend_pi0.checkpoint import PROFILE_FILE
from rn_backend_pi0.documents import ProfileDocument
from rn_backend_pi0.profiles import JOINT_PROFILES
from rn_vla.checkpoint_files import read_schema
from rn_vla.joint_rows import declare_joints
from roboneuron import EE_DELTA, ControlSpace, RobotProfile


def pi0_space(options: Mapping[str, object], profile: RobotProfile) -> ControlSpace:
    """The space of the profile that the options or the checkpoint's roboneuron.json name.

    Profiles that are not among `JOINT_PROFILES` move the TCP; `load` checks that the profile
    exists.

    Raises:
        ConfigurationError: the option `joints` is missing or does not match the policy or the
            robot.
        CheckpointError: roboneuron.json cannot be read.
    """
    name = options.get("profile") or _declared(options.get("checkpoint"))
    if not isinstance(name, str) or name not in JOINT_PROFILES:
        return EE_DELTA
    return declare_joints(JOINT_PROFILES[name], options, profile, policy=f"Profile {name!r}")


def _declared(checkpoint: object) -> str:
    """Profile named by the checkpoint; empty if it names none."""
    if not isinstance(checkpoint, str | Path):
        return ""
    sidecar = Path(checkpoint) / PROFILE_FILE
    return read_schema(sidecar, ProfileDocument).profile if sidecar.exists() else ""
