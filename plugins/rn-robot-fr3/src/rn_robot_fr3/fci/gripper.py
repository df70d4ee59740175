"""The Franka Hand in a separate thread, because its commands block until a motion ends."""

from __future__ import annotations

import logging
import threading
import time
from typing import TYPE_CHECKING

from rn_robot_fr3.fci.options import FciDriverOptions
from rn_robot_fr3.limits import FINGER_OPEN_M
from roboneuron import NotReadyError

if TYPE_CHECKING:
    from types import ModuleType

    import franky

log = logging.getLogger(__name__)

_CLOSED_M = 0.004
"""A width up to this requests a grasp: close with force on any object."""
_NOTHING_M = 0.003
"""Width up to which closed fingers hold nothing."""
_MISSED_M = 0.004
"""A motion that ends this far from its target width was blocked."""
_SAME_M = 0.001
_PERIOD_S = 0.05
_JOIN_S = 3.0
_MOTION_S = 30.0
"""Longer than any motion of the hand; homing takes about 10 s."""


class FciGripper:
    """Follows the newest width; every method may be called from any thread.

    Attributes:
        width_m: last measured width, 0 .. 0.08.
        note: "moving", "at ...", "grasped ...", "nothing grasped", "blocked at ...", "at rest" or
            the reason of a failure.
        is_holding: True while it holds an object with force.
    """

    def __init__(self, options: FciDriverOptions, client: ModuleType) -> None:
        self._options = options
        self._client = client
        self._hand: franky.Gripper = None  # until open
        self._thread: threading.Thread | None = None
        self._changed = threading.Condition()
        self._wanted_m: float | None = None
        self._done_m: float | None = None
        self._stop = False
        self.width_m = 2 * FINGER_OPEN_M
        self.note = "at rest"
        self.is_holding = False

    def open(self) -> None:
        """Connect. Raises NotReadyError if there is no gripper."""
        try:
            self._hand = self._client.Gripper(self._options.host)
            self.width_m = float(self._hand.state.width)
            self.is_holding = bool(self._hand.state.is_grasped)
        except Exception as error:
            raise NotReadyError(
                f"The robot at {self._options.host} has no gripper that answers: "
                f"{str(error).splitlines()[0]}",
                hint="Mount and configure the Franka Hand in Desk, or set gripper = false.",
            ) from error
        self._stop, self._wanted_m, self._done_m = False, None, None
        if self.is_holding:
            self.note = f"grasped {self.width_m * 1e3:.0f} mm"
        self._thread = threading.Thread(target=self._run, name="fci-gripper", daemon=True)
        self._thread.start()

    def aim(self, width_m: float) -> None:
        """Move to a width [m]; a width of nearly zero grasps. Returns immediately; the newest
        command counts.

        A held object stays held with force until a larger width than its own is commanded. The same
        holds for an object held before the first command: commanding the current width then has no
        effect.
        """
        with self._changed:
            if self._wanted_m is None and abs(width_m - self.width_m) <= _MISSED_M:
                return
            if self._wanted_m is None or abs(width_m - self._wanted_m) > _SAME_M:
                self._wanted_m = width_m
                self._changed.notify()

    def close(self) -> None:
        """End the thread; a held object stays held."""
        with self._changed:
            self._stop = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None
        self._hand = None

    def _run(self) -> None:
        try:
            if self._hand.state.max_width < _CLOSED_M:
                self.note = "homing"
                self._finish(self._hand.homing_async())
                self.note = "at rest"
        except Exception as error:
            self.note = f"homing failed: {error}"
        while not self._stop:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._stop or self._wanted_m != self._done_m, timeout=_PERIOD_S
                )
                wanted = self._wanted_m
            try:
                if wanted is not None and wanted != self._done_m and not self._stop:
                    self._done_m = wanted
                    self._execute(wanted)
                self._measure()
            except Exception as error:  # the thread's border; the next command tries again
                self.note = f"failed: {str(error).splitlines()[0]}"
                time.sleep(_PERIOD_S)

    def _measure(self) -> None:
        """Between two motions: measure the width, and whether the held object is still there."""
        self.width_m = float(self._hand.state.width)
        if self.is_holding and self.width_m < _NOTHING_M:
            self.is_holding, self.note = False, "lost what it held"

    def _execute(self, width_m: float) -> None:
        self.note = "moving"
        speed = self._options.gripper_speed_m_s
        if self.is_holding and width_m < self.width_m + _SAME_M:
            self.note = f"grasped {self.width_m * 1e3:.0f} mm"
            return
        if width_m <= _CLOSED_M:
            self._grasp()
            return
        self.is_holding = False
        is_closing = width_m < self.width_m
        arrived = self._finish(self._hand.move_async(width_m, speed))
        self.width_m = float(self._hand.state.width)
        missed_m = abs(self.width_m - width_m)
        if is_closing and self.width_m - width_m > _MISSED_M and not self._stop:
            self._grasp()  # a blocked motion ends without force
            return
        if not arrived or missed_m > _MISSED_M:
            self.note = (
                f"blocked at {self.width_m * 1e3:.0f} mm on the way to {width_m * 1e3:.0f} mm"
            )
        else:
            self.note = f"at {self.width_m * 1e3:.0f} mm"

    def _grasp(self) -> None:
        """Close with force on any object."""
        options = self._options
        speed, force = options.gripper_speed_m_s, options.grasp_force_n
        self._finish(self._hand.grasp_async(0.0, speed, force, 0.0, 2 * FINGER_OPEN_M))
        self.width_m = float(self._hand.state.width)
        self.is_holding = self.width_m >= _NOTHING_M
        self.note = f"grasped {self.width_m * 1e3:.0f} mm" if self.is_holding else "nothing grasped"

    def _finish(self, future: franky.BoolFuture) -> bool:
        """Wait for the end of a motion and measure meanwhile.

        Raises:
            TimeoutError: it did not end in time; the next command is then executed.
        """
        deadline_s = time.monotonic() + _MOTION_S
        while not future.wait(_PERIOD_S):
            if self._stop:
                return False
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"no end of a motion within {_MOTION_S:g} s.")
            self.width_m = float(self._hand.state.width)
        return bool(future.get())
