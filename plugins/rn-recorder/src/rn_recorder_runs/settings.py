"""Settings of the recorder's process, sent by the server as one line of JSON on stdin."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from roboneuron.command import environment
from roboneuron.feature import log_files

SWITCH, PLAY = "ROBONEURON_RECORDER", "play"
"""Environment variable of a server: "off" disables recording (tests, small machines); PLAY too, but
the server then offers play_recording.
"""
_SLOT = 14
"""Port slot of the first recorder: those that modules use last, see `port_offset`."""


class CameraMount(BaseModel):
    """Mount of a camera's optical frame from the profile: position [m] and quaternion x y z w in
    `parent`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    parent: str
    frame_id: str
    position_m: tuple[float, float, float]
    quaternion_xyzw: tuple[float, float, float, float]


class RulesSettings(BaseModel):
    """Settings of `rn_recorder_runs.recording.Rules`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    ring_s: float
    after_s: float
    part_bytes: int
    part_s: float
    quota_bytes: int
    min_free_bytes: int
    keep_s: float = 0.0
    incident_s: float = 300.0


class RecorderSettings(BaseModel):
    """All settings of the recorder's process.

    Attributes:
        namespace: namespace of the robot, without leading and trailing slashes.
        state_directory: directory of the audit.
        directory: directory of the runs.
        topics, exclude: patterns; those without a leading slash are under the namespace.
        images: "jpeg" or "lossless".
        about: metadata of every file.
        urdf, mounts: of the robot, for `robot_description` and transforms; empty for none.
        resume, resume_name: a recording to be continued from a previous recorder.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    namespace: str
    state_directory: Path
    directory: Path
    topics: tuple[str, ...]
    exclude: tuple[str, ...]
    images: Literal["jpeg", "lossless"]
    jpeg_quality: int
    rules: RulesSettings
    about: Mapping[str, str]
    urdf: str = ""
    mounts: tuple[CameraMount, ...] = ()
    resume: str = ""
    resume_name: str = ""


def spawn_recorder(
    settings: RecorderSettings, log_path: Path, start: int, secrets: Collection[str]
) -> subprocess.Popen[bytes]:
    """Start the recorder's process, in a separate group within this session (so the kernel resumes
    a stopped one when the server dies); stdin and stdout are pipes.

    Args:
        settings: its first line.
        log_path: file of its stderr.
        start: number of recorders that this server started before.
        secrets: environment variables that are withheld from it.

    Raises:
        OSError: it cannot be started.
    """
    with open(log_path, "ab", opener=log_files.opener) as output:
        child = subprocess.Popen(  # owned by RecorderProcess
            [sys.executable, "-P", "-m", "rn_recorder_runs.node"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=output,
            env={
                **environment.module_environment(None, _SLOT + start, secrets),
                "OMP_NUM_THREADS": "1",
            },
            cwd=os.getcwd(),
            process_group=0,
        )
    assert child.stdin is not None
    try:
        child.stdin.write(settings.model_dump_json().encode() + b"\n")
        child.stdin.flush()
    except BrokenPipeError:  # it ended already; its owner detects that
        pass
    return child
