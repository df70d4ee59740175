"""Runs a simulation in real time in a separate thread, for drivers of simulated robots."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager

from rn_simulation.pace import Pace
from roboneuron import NotReadyError, RoboNeuronError, StateError, UnsafeError

_START_TIMEOUT_S = 30.0
_STOP_TIMEOUT_S = 10.0

Advance = Callable[[int, float, bool], None]
"""Executes this many steps; the further arguments are the achieved real-time factor, and whether to
publish the state.
"""


class RealTimeThread:
    """Runs the time of one simulation; every method may be called from any thread but its own.

    Attributes:
        stepping: lock for commands to the simulation; `advance` holds it during steps.
    """

    def __init__(
        self,
        robot: str,
        *,
        step_s: float,
        factor: float = 1.0,
        catch_up_s: float = 0.05,
        publish_rate_hz: float,
    ) -> None:
        """Store the arguments.

        Args:
            robot: name of the robot in messages.
            step_s, factor, catch_up_s: see `Pace`.
            publish_rate_hz: rate at which `advance` is asked to publish [1/s of wall time].
        """
        self._robot = robot
        self._step_s, self._factor, self._catch_up_s = step_s, factor, catch_up_s
        self._publish_period_s = 1.0 / publish_rate_hz
        self.stepping = threading.Lock()
        self._thread: threading.Thread | None = None
        self._started = threading.Event()
        self._stop = threading.Event()
        self._failure: Exception | None = None

    @property
    def is_running(self) -> bool:
        """True if it was started and has not failed."""
        return self._thread is not None and self._failure is None

    def check_stopped(self) -> None:
        """Raise StateError if it was started and not stopped since."""
        if self._thread is not None:
            raise StateError(f"The simulated {self._robot} is open already.")

    def check_running(self) -> None:
        """Return if time is running.

        Raises:
            StateError: it was not started.
            UnsafeError: the simulation failed while running.
        """
        if self._thread is None:
            raise StateError(f"The simulated {self._robot} is not open.")
        if self._failure is not None:
            raise UnsafeError(
                f"The simulation stopped: {self._failure}.", hint="Stop and start the robot."
            )

    def start(self, simulation: AbstractContextManager[object], advance: Advance) -> None:
        """In the thread: enter `simulation`, advance by zero steps, then run; `stop` exits it.

        Raises:
            StateError: it was already started.
            NotReadyError: it did not start in time, or failed with an error other than
                RoboNeuronError.
            RoboNeuronError: raised by entering the simulation or by `advance`.
        """
        self.check_stopped()
        self._started.clear()
        self._stop.clear()
        self._failure = None
        self._thread = threading.Thread(
            target=self._run,
            args=(simulation, advance),
            name=f"{self._robot}-simulation",
            daemon=True,
        )
        self._thread.start()
        if not self._started.wait(_START_TIMEOUT_S):
            self.stop()
            raise NotReadyError(
                f"The simulated {self._robot} did not start within {_START_TIMEOUT_S:g} s."
            )
        self._check_started()

    def _check_started(self) -> None:
        failure = self._failure
        if failure is None:
            return
        self.stop()
        if isinstance(failure, RoboNeuronError):
            raise failure
        raise NotReadyError(f"The simulated {self._robot} did not start: {failure}.") from failure

    def stop(self) -> None:
        """End the thread; may be called twice and before `start`."""
        self._stop.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_STOP_TIMEOUT_S)

    def _run(self, simulation: AbstractContextManager[object], advance: Advance) -> None:
        try:
            with simulation:
                advance(0, 0.0, True)
                self._started.set()
                self._keep_pace(advance)
        except Exception as error:  # raised again by start() and check_running()
            self._failure = error
            self._started.set()

    def _keep_pace(self, advance: Advance) -> None:
        pace = Pace(step_s=self._step_s, factor=self._factor, catch_up_s=self._catch_up_s)
        period_s = self._publish_period_s
        published_s = time.monotonic()
        while not self._stop.is_set():
            steps = pace.due_steps(time.monotonic())
            if steps == 0:
                self._stop.wait(pace.until_next_s(time.monotonic()))
                continue
            now_s = time.monotonic()
            is_due = now_s - published_s >= period_s
            if is_due:
                published_s = max(published_s + period_s, now_s - period_s)
            advance(steps, pace.achieved_factor, is_due)
