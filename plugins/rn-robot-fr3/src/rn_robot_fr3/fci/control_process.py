"""The process that answers the arm once a millisecond: `python -m rn_robot_fr3.fci.control_process
DESCRIPTOR`.

Started by `rn_robot_fr3.fci.arm` as a separate process, so that no pause of the driver's Python
affects the arm. It uses pylibfranka, which cannot be imported together with franky (both register
the same types), and exchanges JSON messages with its parent over a socket. Requests ("connect",
"configure", "recover") are answered, "go" and "brake" are not; states are sent back 125 times a
second. It brakes if its parent has ended or is silent, and after an error nothing moves until
"recover".
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rn_robot_fr3.fci.follower import (
    LONGEST_GAP,
    LONGEST_UNHEARD,
    STEP_S,
    Course,
    Follower,
    PlannerError,
)

if TYPE_CHECKING:
    from types import ModuleType

    import pylibfranka

PRIORITY = 20
SILENT_S = 0.5
"""The parent sends a message every 20 ms; after this time without one its process counts as
frozen.
"""
_ANSWER_S = 0.0006
"""A command this long after its state may miss its cycle, so it is not sent."""
_REPORT_S = 0.008
_IDLE_S = 0.004
_MESSAGE_BYTES = 65536
_MCL_CURRENT_AND_FUTURE = 3
"""Source: linux/mman.h."""
_FIELDS = ("q", "dq", "tau_J", "tau_ext_hat_filtered", "O_F_ext_hat_K", "O_T_EE")
_REALTIME = Path("/sys/kernel/realtime")


class RealtimeException(Exception):
    """The kernel is not real-time."""


class CommunicationLost(Exception):
    """States were missing for longer than the arm extrapolates, or commands arrive too late."""


class ControlProcess:
    """One connection to the arm, with its control loop during motions."""

    def __init__(self, link: socket.socket, client: ModuleType, is_realtime: bool) -> None:
        self._link, self._client, self._is_realtime = link, client, is_realtime
        self._robot: Any = None  # pylibfranka.Robot, once connected
        self._control: Any = None  # pylibfranka.ActiveControlBase during a motion
        self._follower: Follower | None = None
        self._course: Course | None = None
        self._stop: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
        self._at_ms = 0
        self._missed = self._longest = self._silences = 0
        self._heard_s = self._reported_s = time.monotonic()
        self._number = 0
        self._is_faulty = False
        self._is_ending = False
        self._flags: list[str] = [name for name in dir(client.Errors) if not name.startswith("_")]

    def run(self) -> None:
        """Run until the parent ends or requests the end, and the arm stands."""
        while not (self._is_ending and self._control is None):
            try:
                if self._control is not None:
                    self._cycle()
                else:
                    self._idle()
            except (
                Exception
            ) as error:  # the parent handles every error that ends a motion or the connection
                self._fail(error)

    def _idle(self) -> None:
        ready, _, _ = select.select([self._link], [], [], _IDLE_S)
        if ready:
            self._listen()
        if self._robot is None or self._is_ending:
            return
        if self._course is not None and not self._is_faulty:
            self._begin()
            return
        self._report(self._robot.read_once())

    def _begin(self) -> None:
        self._control = self._robot.start_joint_position_control(
            self._client.ControllerMode.JointImpedance
        )
        state, _ = self._control.readOnce()
        self._at_ms = _milliseconds(state.time)
        self._follower = Follower(list(state.q_d), *self._stop)
        assert self._course is not None
        self._follower.aim(self._course)
        position = list(state.q_d)
        self._follower.expect(position)
        self._control.writeOnce(self._client.JointPositions(position))

    def _cycle(self) -> None:
        """Read a state, answer it, then process requests of the parent."""
        assert self._follower is not None
        state, _ = self._control.readOnce()
        read_s = time.monotonic()
        now_ms = _milliseconds(state.time)
        cycles, self._at_ms = max(1, now_ms - self._at_ms), now_ms
        if cycles > 1:
            self._missed += cycles - 1
            self._longest = max(self._longest, cycles - 1)
        position = self._follower.next(state.q_d, state.dq_d, state.ddq_d, cycles)
        if cycles > LONGEST_GAP:
            self._give_up(f"no state of the robot came for {cycles} ms")
        elif self._follower.unheard > LONGEST_UNHEARD:
            self._give_up(
                f"the robot took none of the last {LONGEST_UNHEARD} commands: each came later "
                "than 1 ms"
            )
        command = self._client.JointPositions(position)
        if self._course is None and self._follower.is_resting:
            command.motion_finished = True
            self._control.writeOnce(command)
            self._end_motion()
        elif time.monotonic() - read_s > _ANSWER_S:
            self._follower.skip()
        else:
            self._control.writeOnce(command)
        if read_s - self._reported_s >= _REPORT_S:
            self._report(state)
        self._listen()
        if read_s - self._heard_s > SILENT_S and self._course is not None:
            self._silences += 1
            self._brake()

    def _give_up(self, why: str) -> None:
        """Brake, and block motions until a recovery."""
        if not self._is_faulty:
            self._is_faulty = True
            self._brake()
            self._tell_end(CommunicationLost(why))

    def _end_motion(self) -> None:
        self._control = self._follower = None
        gc.collect()

    def _brake(self) -> None:
        self._course = None
        if self._follower is not None:
            self._follower.brake()

    def _fail(self, error: Exception) -> None:
        """Handle a motion or connection that ended by itself."""
        self._course = None
        self._is_faulty = True
        with contextlib.suppress(Exception):  # the same cause may end this too
            self._control = None
        self._follower = None
        if type(error).__name__ == "NetworkException":
            self._robot = None
        elif self._robot is not None:
            # the state shows the mode after the error
            with contextlib.suppress(Exception):
                self._report(self._robot.read_once())
        self._tell_end(error)

    def _listen(self) -> None:
        """Process the parent's requests."""
        while True:
            try:
                message = self._link.recv(_MESSAGE_BYTES, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            except OSError:
                message = b""
            self._heard_s = time.monotonic()
            if not message:
                self._end()
                return
            self._do(json.loads(message))

    def _do(self, asked: dict[str, Any]) -> None:
        what = asked["do"]
        if what == "go":
            self._number = asked["number"]
            if not self._is_faulty:
                self._course = Course(**{name: tuple(asked[name]) for name in Course.__slots__})
                if self._follower is not None:
                    self._follower.aim(self._course)
        elif what == "brake":
            self._brake()
        elif what != "alive":
            self._answer(asked)

    def _answer(self, asked: dict[str, Any]) -> None:
        """Execute a request and answer with name and text of its error, empty on success."""
        kind = text = ""
        try:
            getattr(self, f"_{asked['do']}")(**asked.get("arguments", {}))
        except Exception as error:
            kind, text = type(error).__name__, str(error)
        self._tell({"answer": asked["number"], "kind": kind, "text": text})

    def _hello(self) -> None:
        """Confirm that the process runs."""

    def _connect(
        self, host: str, is_required: bool, stop_acceleration: list[float], stop_jerk: list[float]
    ) -> None:
        if is_required and not (_REALTIME.exists() and _REALTIME.read_text().strip() == "1"):
            raise RealtimeException(
                "/sys/kernel/realtime is not 1, so this is no PREEMPT_RT kernel."
            )
        config = self._client.RealtimeConfig
        self._stop = tuple(stop_acceleration), tuple(stop_jerk)
        self._robot = self._client.Robot(host, config.kEnforce if is_required else config.kIgnore)
        self._report(self._robot.read_once())

    def _configure(
        self, torque_nm: float, force_n: float, load_kg: float, centre_m: list[float]
    ) -> None:
        torques, forces = [torque_nm] * 7, [force_n] * 6
        self._robot.set_collision_behavior(torques, torques, forces, forces)
        if load_kg > 0.0:
            self._robot.set_load(load_kg, centre_m, [0.0] * 9)

    def _recover(self) -> None:
        self._brake()
        self._robot.automatic_error_recovery()
        self._is_faulty = False
        self._report(self._robot.read_once())

    def _end(self) -> None:
        self._is_ending = True
        self._brake()

    def end(self, *_: object) -> None:
        """Brake, then end; a signal handler."""
        self._end()

    def _report(self, state: pylibfranka.RobotState) -> None:
        self._reported_s = time.monotonic()
        errors = state.current_errors
        self._tell(
            {
                **{name: list(getattr(state, name)) for name in _FIELDS},
                "mode": state.robot_mode.name,
                "rate": state.control_command_success_rate,
                "errors": [name for name in self._flags if getattr(errors, name) is True]
                if errors
                else [],
                "number": self._number,
                "moving": self._control is not None,
                "realtime": self._is_realtime,
                "missed": self._missed,
                "longest": self._longest,
                "silences": self._silences,
            }
        )

    def _tell_end(self, error: Exception) -> None:
        kind = "PlannerException" if isinstance(error, PlannerError) else type(error).__name__
        self._tell({"ended": kind, "text": str(error)})

    def _tell(self, message: dict[str, object]) -> None:
        """Send without blocking: a parent that does not read loses states, and the arm still gets
        its answer.
        """
        with contextlib.suppress(OSError):
            self._link.send(json.dumps(message).encode(), socket.MSG_DONTWAIT)


def _milliseconds(time_of_state: pylibfranka.Duration) -> int:
    seconds: float = time_of_state.to_sec()
    return round(seconds / STEP_S)


def _is_first_in_line() -> bool:
    """Request SCHED_FIFO and locked memory; return whether the former was granted."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError:
        return False
    ctypes.CDLL(None).mlockall(_MCL_CURRENT_AND_FUTURE)
    return True


def main() -> None:
    """Run on the socket whose descriptor is the argument."""
    link = socket.socket(fileno=int(sys.argv[1]))
    process = ControlProcess(link, importlib.import_module("pylibfranka"), _is_first_in_line())
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, process.end)
    gc.freeze()
    gc.disable()
    process.run()


if __name__ == "__main__":
    main()
