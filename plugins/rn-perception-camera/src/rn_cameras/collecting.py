"""Pictures for a calibration, taken when a person says so; the person moves arm and board."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from rn_cameras.board import Board
from rn_cameras.calibrating import Forward, Setup
from rn_cameras.live import moved
from rn_cameras.pictures import STILL, VIEW, MeasuredFile, PictureFolder
from roboneuron import Frame, RoboNeuronError

ENOUGH = 15
"""Pictures after which the person is told that they are enough."""
END = "q"


class Joints(Protocol):
    """MeasuredFile joints; see `live.ArmJoints`."""

    def read(self) -> dict[str, float]: ...


class Collector:
    """One calibration's dialogue.

    Args:
        folder: where pictures and measurements are kept.
        board: what the pictures show.
        take: takes a picture; raises RoboNeuronError.
        joints: None without an arm.
        ask: asks the person a question; Enter is "".
        tell: tells the person a line.
    """

    def __init__(
        self,
        folder: PictureFolder,
        board: Board,
        take: Callable[[], Frame],
        joints: Joints | None,
        ask: Callable[[str], str],
        tell: Callable[[str], object],
    ) -> None:
        self._folder = folder
        self._board = board
        self._take = take
        self._joints = joints
        self._ask = ask
        self._tell = tell
        self._measured = folder.measured()

    def collect(self, setup: Setup, forward: Forward) -> None:
        """Take pictures until the person ends it; for `corners` the board's place as well.

        Raises:
            OSError: a file cannot be written.
        """
        earlier = len(self._folder.names(""))
        if earlier or self._measured.corners:
            self._tell(
                f"{self._folder.path} holds {earlier} pictures and "
                f"{len(self._measured.corners)} corners of before, which count too. Name another "
                "--out if camera or board has been moved since."
            )
        self._tell(
            {
                "eye-in-hand": "Lay the board down where it stays. Move the hand with the camera.",
                "eye-to-hand": "Fix the board to the hand. Move the hand before the camera.",
                "corners": "Hold the board before the camera.",
            }[setup]
            + f" Tilt by 20 to 45 degrees, about several axes; {ENOUGH} pictures, all over the "
            "camera's view."
        )
        self._pictures(VIEW, with_joints=setup != "corners")
        if setup != "corners":
            return
        self._tell("Lay the board down where camera and arm reach it, and take one picture.")
        self._pictures(STILL, with_joints=False)
        if not self._measured.corners:
            self._touch(forward)

    def _pictures(self, kind: str, *, with_joints: bool) -> None:
        count = len(self._folder.names(kind))
        while self._ask(f"{count} taken. Enter: next picture, {END}: end. ") != END:
            try:
                count += self._picture(kind, with_joints=with_joints)
            except RoboNeuronError as error:
                self._tell(f"  not kept: {error}")
            if count == ENOUGH and kind == VIEW:
                self._tell("  These are enough.")

    def _picture(self, kind: str, *, with_joints: bool) -> bool:
        """Take a picture; True if it is kept."""
        before = self._joints.read() if with_joints and self._joints is not None else {}
        frame = self._take()
        after = self._joints.read() if with_joints and self._joints is not None else {}
        if moved(before, after):
            self._tell("  not kept: the arm moved.")
            return False
        seen = self._board.find(frame.image)
        if seen is None:
            self._tell("  not kept: the board is not seen.")
            return False
        name = self._folder.add(kind, frame.image)
        calibration = frame.calibration
        intrinsics = None
        if calibration is not None:
            fx, fy, cx, cy = calibration.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
            intrinsics = (fx, fy, cx - 0.5, cy - 0.5)
        joints = {**self._measured.joints, **({name: after} if after else {})}
        self._note(intrinsics=intrinsics, joints=joints)
        self._tell(f"  {name}: {len(seen.numbers)} corners.")
        return True

    def _touch(self, forward: Forward) -> None:
        """Measure the board's corners by the TCP. Without an arm they must be given."""
        while self._joints is not None and len(self._measured.corners) < 3:
            number = len(self._measured.corners) + 1
            if self._ask(f"Touch outer corner {number} with the TCP, then Enter. ") == END:
                return
            try:
                place_m = forward(self._joints.read()).position_m
            except RoboNeuronError as error:
                self._tell(f"  {error}")
                continue
            corner = tuple(np.round(place_m, 6).tolist())
            self._note(corners={**self._measured.corners, number: corner})
            self._tell(f"  corner {number}: {corner}")

    def _note(self, **changes: object) -> None:
        self._measured = MeasuredFile.model_validate({**self._measured.model_dump(), **changes})
        self._folder.note(self._measured)
