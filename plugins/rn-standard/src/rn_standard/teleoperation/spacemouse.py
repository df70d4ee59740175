"""Teleoperator for a 3Dconnexion SpaceMouse, read as a Linux hidraw device.

Source of the reports: the USB HID descriptor of the device. Report 1 contains x y z as int16
(little endian), report 2 the rotations about them; newer devices send all six in report 1. Report 3
contains the buttons as bits. x points to the right, y to the person, z down; a full push is about
350.
"""

from __future__ import annotations

import os
import select
import struct
import time
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rn_standard.teleoperation.samples import F64, LeadSample, Subscribe
from roboneuron import InvalidInputError, NotReadyError, RobotProfile

_VENDORS = ("0000046D", "0000256F")
"""Vendor ids of Logitech, which made the first devices, and of 3Dconnexion, as in HID_ID of the
kernel's uevent.
"""
_NAMES = ("space", "3dconnexion")
_CLASS = Path("/sys/class/hidraw")
_FULL = 350.0
_FULL_M_S, _FULL_RAD_S = 0.25, 0.8
_DEAD = 0.06
"""Dead zone as a fraction of a full push: the cap does not return to zero exactly."""
_MOST_BYTES = 64
_TO_BASE = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Conversion of the device's axes (right, towards the person, down) to the person's (forwards,
left, up).
"""
_MOVE, _ROTATE, _BUTTONS = 1, 2, 3


class SpaceMouseOptions(BaseModel):
    """Options of `spacemouse`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    device: str = Field(default="", description="such as /dev/hidraw3; empty: the only one found")
    frame: Literal["base", "tool"] = Field(default="base", description="of its axes")


class SpaceMouse:
    """Implementation of `Teleoperator`. The first button is the switch, the second one opens and
    closes the gripper.
    """

    def __init__(self, config: SpaceMouseOptions | None, profile: RobotProfile) -> None:
        self._options = config or SpaceMouseOptions()
        self._path = ""
        self._fd = -1
        self._axes: F64 = np.zeros(6)
        self._buttons = 0
        self._gripper_open: float | None = None
        self._heard_s = 0.0
        self._number = 0

    def open(self, subscribe: Subscribe) -> None:
        """Open the device.

        Raises:
            NotReadyError: there is none, there are several, or it is not readable.
        """
        self._path = self._options.device or _found(_CLASS)
        try:
            self._fd = os.open(self._path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise NotReadyError(
                f"The SpaceMouse {self._path} cannot be opened: {error.strerror}.",
                hint="Plug it in, and let this user read it (a udev rule for hidraw).",
            ) from error
        self._heard_s = time.monotonic()

    def read(self, timeout_s: float) -> LeadSample | None:
        """See `Teleoperator`. A cap at rest sends nothing, so it counts as measured now. A pushed
        cap that stops sending does not.

        Raises:
            NotReadyError: it was unplugged.
            InvalidInputError: it sends an invalid report.
        """
        ready, _, _ = select.select([self._fd], [], [], timeout_s)
        while ready:
            report = self._report()
            if report is None:
                break
            self._take(report)
        now_s = time.monotonic()
        if not self._axes.any():
            self._heard_s = now_s
        self._number += 1
        return LeadSample(
            number=self._number,
            at_s=self._heard_s,
            is_held=bool(self._buttons & 1),
            twist=self._twist(),
            frame=self._options.frame,
            gripper_open=self._gripper_open,
        )

    def close(self) -> None:
        """See `Teleoperator`."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def _report(self) -> bytes | None:
        """Read the next report; None without one. Raises NotReadyError."""
        try:
            report = os.read(self._fd, _MOST_BYTES)
        except BlockingIOError:
            return None
        except OSError as error:
            raise self._unplugged(error.strerror or "") from error
        if not report:
            raise self._unplugged("its file has ended")
        return report

    def _unplugged(self, why: str) -> NotReadyError:
        return NotReadyError(
            f"The SpaceMouse {self._path} is gone ({why}); the arm rests.",
            hint="Plug it in, and lead again.",
        )

    def _take(self, report: bytes) -> None:
        kind, data = report[0], report[1:]
        if kind == _BUTTONS and data:
            pressed = int.from_bytes(data[:4], "little")
            if pressed & ~self._buttons & 2:
                self._gripper_open = 0.0 if self._gripper_open == 1.0 else 1.0
            self._buttons = pressed
        elif kind == _MOVE and len(data) >= 12:
            self._axes = _axes(data[:12])
        elif kind in (_MOVE, _ROTATE) and len(data) >= 6:
            first = 0 if kind == _MOVE else 3
            self._axes = self._axes.copy()
            self._axes[first : first + 3] = _axes(data[:6])
        elif kind in (_MOVE, _ROTATE, _BUTTONS):
            raise InvalidInputError(
                f"The SpaceMouse {self._path} sent a report {kind} of {len(data)} bytes; the arm "
                "rests.",
                hint="Is this device a SpaceMouse? Set `device` of [plugins.spacemouse].",
            )
        self._heard_s = time.monotonic()

    def _twist(self) -> F64:
        shares = np.clip(self._axes / _FULL, -1.0, 1.0)
        shares = np.where(np.abs(shares) < _DEAD, 0.0, shares)
        return np.concatenate(
            [_TO_BASE @ shares[:3] * _FULL_M_S, _TO_BASE @ shares[3:] * _FULL_RAD_S]
        )


def _axes(data: bytes) -> F64:
    return np.array(struct.unpack(f"<{len(data) // 2}h", data), dtype=np.float64)


def _found(folder: Path) -> str:
    """Find the device file of the only SpaceMouse. Raises NotReadyError."""
    found: list[str] = []
    for entry in sorted(folder.glob("hidraw*")) if folder.is_dir() else ():
        try:
            told = (entry / "device" / "uevent").read_text(encoding="utf-8")
        except OSError:
            continue
        facts = dict(line.split("=", 1) for line in told.splitlines() if "=" in line)
        vendor = facts.get("HID_ID", "").upper().split(":")[1:2]
        name = facts.get("HID_NAME", "").lower()
        if vendor and vendor[0] in _VENDORS and any(word in name for word in _NAMES):
            found.append(f"/dev/{entry.name}")
    if len(found) != 1:
        raise NotReadyError(
            f"{len(found)} SpaceMice are plugged in ({', '.join(found) or 'none'}), expected one.",
            hint="Plug one in, or set `device` of [plugins.spacemouse].",
        )
    return found[0]
