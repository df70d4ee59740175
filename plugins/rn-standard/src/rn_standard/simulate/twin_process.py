"""The process of a twin: what goes wrong in a physics engine ends a simulation, not the server."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from rn_standard.simulate.twin import HasTwin, Twin
from roboneuron import (
    ActionChunk,
    Backend,
    BackendSpec,
    DriverSpec,
    JointCommand,
    JointSample,
    NotReadyError,
    Observation,
    RoboNeuronError,
    RobotProfile,
    StateError,
)
from roboneuron.answering_process import AnsweringProcess
from roboneuron.feature import build

M = TypeVar("M")


class TwinProcess:
    """Follows the protocol `Twin`, in another process; used from one thread.

    Args:
        spec: of the simulated driver.
        options: its options.
        profile: of the robot.
        end_s: monotonic time by which the first answer is there [s].

    Attributes:
        end_s: monotonic time after which the process is killed instead of being waited for [s].
        key: what it was made from.

    Raises:
        NotReadyError: the driver has no twin, or the process ended or did not answer.
    """

    def __init__(
        self,
        spec: DriverSpec,
        options: Mapping[str, object],
        profile: RobotProfile,
        end_s: float,
    ) -> None:
        self.end_s = end_s
        self.key = (spec, repr(options))
        self._process = AnsweringProcess(
            "The twin of the cell", "rn_standard.simulate.twin_process:ServedTwin"
        )
        try:
            self.scene_topic, self.scene_type = self._ask("make", spec, options, profile)
        except RoboNeuronError:
            self.end()
            raise

    @property
    def is_alive(self) -> bool:
        """Whether it can be asked."""
        return self._process.is_alive

    def open(self, joints: JointSample, scene: object = None) -> None:
        """See `Twin`."""
        self._ask("open", joints, scene)

    def send(self, command: JointCommand) -> None:
        """See `Twin`."""
        self._ask("send", command)

    def advance(self, duration_s: float) -> None:
        """See `Twin`."""
        self._ask("advance", duration_s)

    def joints(self) -> JointSample:
        """See `Twin`."""
        return cast("JointSample", self._ask("joints"))

    def moved(self) -> tuple[str, ...]:
        """See `Twin`."""
        return cast("tuple[str, ...]", self._ask("moved"))

    def picture(self, camera: str, width: int, height: int) -> NDArray[np.uint8]:
        """See `Twin`."""
        return cast("NDArray[np.uint8]", self._ask("picture", camera, width, height))

    def close(self) -> None:
        """See `Twin`; the process stays for the next simulation."""
        with suppress(NotReadyError):
            self._ask("close")

    def load_policy(self, spec: BackendSpec, options: Mapping[str, object]) -> None:
        """Load the policy of a task, instead of the last one. Raises NotReadyError."""
        self._ask("load_policy", spec, options)

    def begin_task(self) -> None:
        """Have the policy forget what it has seen."""
        self._ask("begin_task")

    def predict(self, observation: Observation) -> tuple[ActionChunk | None, str]:
        """What the policy does, or why it does nothing. Raises NotReadyError."""
        return cast("tuple[ActionChunk | None, str]", self._ask("predict", observation))

    def end(self) -> None:
        """End the process; may be called twice."""
        self._process.end()

    def _ask(self, name: str, *arguments: object) -> Any:
        """What the twin answers. Raises NotReadyError: with what it failed, or it is gone."""
        try:
            return self._process.ask(name, *arguments, end_s=self.end_s)
        except NotReadyError:
            raise
        except RoboNeuronError as error:
            raise NotReadyError(f"The twin of the cell failed: {error}") from error


class _NoTopics:
    """What a driver that only makes twins is lent of the ROS graph: nothing."""

    def subscribe(
        self,
        topic: str,
        message_type: type[M],
        callback: Callable[[M], None],
        *,
        best_effort: bool = False,
    ) -> None:
        raise StateError("A twin hears nothing.")

    def advertise(self, topic: str, message_type: type[M]) -> Callable[[M], None]:
        raise StateError("A twin tells nothing.")

    def publisher_types(self, topic: str) -> tuple[str, ...]:
        return ()

    def now_ns(self) -> int:
        return 0


class ServedTwin:
    """The twin and the policy, and how they are made."""

    def __init__(self) -> None:
        self.twin: Twin | None = None
        self._policy: Backend | None = None

    def make(
        self, spec: DriverSpec, options: Mapping[str, object], profile: RobotProfile
    ) -> tuple[str, type[object]]:
        """Where its scenes come from. Raises RoboNeuronError."""
        driver = build(spec, options, profile, _NoTopics())
        if not isinstance(driver, HasTwin):
            raise NotReadyError(
                f"There is no twin of {profile.name!r}: its simulation does not offer one."
            )
        self.twin = driver.twin()
        return self.twin.scene_topic, self.twin.scene_type

    def load_policy(self, spec: BackendSpec, options: Mapping[str, object]) -> None:
        """See `TwinProcess`. Raises RoboNeuronError."""
        if self._policy is not None:
            self._policy.close()
        self._policy = cast("Backend", build(spec, options))
        self._policy.load()

    def begin_task(self) -> None:
        """See `TwinProcess`."""
        if self._policy is not None:
            self._policy.reset()

    def predict(self, observation: Observation) -> tuple[ActionChunk | None, str]:
        """See `TwinProcess`."""
        if self._policy is None:
            return None, "there is no policy"
        try:
            return self._policy.predict(observation), ""
        except RoboNeuronError as error:
            return None, str(error)

    def __getattr__(self, name: str) -> Any:
        """A method of the twin."""
        return getattr(self.twin, name)
