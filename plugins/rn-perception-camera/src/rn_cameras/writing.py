"""Writing of a calibration into roboneuron.toml, whose comments and order stay."""

from __future__ import annotations

import os
import shutil
from collections.abc import MutableMapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit

from rn_cameras.calibrating import Calibrated
from roboneuron import ConfigurationError, foreign, quaternion_from_matrix

SOURCES = ("ros-camera", "video-camera")
"""Perception sources that undistort by coefficients of their options."""


def written(
    text: str, camera: str, source: str, mount: str, made: Calibrated, *, robot: str = ""
) -> str:
    """The text of a configuration with a calibration.

    `[robot.cameras.<name>]` gets mount, pose and intrinsics, the camera's table of the source the
    distortion.

    Args:
        text: of the file.
        camera: name of the camera.
        source: its perception source.
        mount: "base", "tcp" or "<arm>/tcp".
        made: the calibration.
        robot: name of the robot in a file with several; empty in one with `[robot]`.

    Raises:
        ConfigurationError: the lens distorts, and the source is none of SOURCES.
    """
    document = tomlkit.parse(text)
    pose = made.camera.T_mount_camera
    root = ("robots", robot) if robot else ()
    own = _table(document, (*root, "robot", "cameras", camera))
    own["mount"] = mount
    own["position_m"] = _rounded(pose[:3, 3].tolist(), 5)
    own["quaternion_xyzw"] = _rounded(quaternion_from_matrix(pose[:3, :3]).tolist(), 6)
    if not made.is_optics_measured:
        return tomlkit.dumps(document)
    if source not in SOURCES:
        raise ConfigurationError(
            f"The source {source!r} cannot undistort pictures of camera {camera!r}, so that its "
            "measured lens cannot be written.",
            hint=f"A source that can is {' or '.join(SOURCES)}.",
        )
    matrix = made.optics.matrix
    own["size"] = list(made.optics.size)
    own["intrinsics"] = _rounded(matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), 3)
    options = _table(document, (*root, "plugins", source, "cameras", camera))
    options["distortion"] = _rounded(made.optics.distortion.tolist(), 6)
    if "intrinsics" in options:
        del options["intrinsics"]  # the measured ones are the robot's
    return tomlkit.dumps(document)


def replace_file(path: Path, text: str) -> None:
    """Replace a configuration by a new text, with its permissions: whatever happens meanwhile, the
    file holds the old or the new one. Raises OSError.
    """
    path = path.resolve()
    new = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(new, "x", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        shutil.copymode(path, new)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)


def _table(document: tomlkit.TOMLDocument, keys: Sequence[str]) -> MutableMapping[str, Any]:
    """The table at these keys, added if it is missing."""
    table: MutableMapping[str, Any] = document
    for key in keys:
        if key not in table:
            table[key] = tomlkit.table(is_super_table=key != keys[-1])
        table = table[key]
    return table


def _rounded(values: Sequence[float], digits: int) -> list[float]:
    return [round(value, digits) for value in values]


def read(path: Path) -> str:
    """The text of a configuration. Raises ConfigurationError."""
    try:
        return foreign.read_text(path, most_bytes=1 << 20)
    except FileNotFoundError as error:
        raise ConfigurationError(f"There is no file {path.absolute()}.") from error
