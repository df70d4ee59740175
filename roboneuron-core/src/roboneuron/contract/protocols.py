"""Protocols of plugin classes: small interfaces, pure constructors; `load`/`open` do the work,
`close` is idempotent.

The class named by a descriptor's `target` is called as `target(config, ...)` with the arguments
that its protocol names. `config` is an instance of the pydantic model that the descriptor's
`config` names, or None without one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Never, Protocol, TypeAlias, TypeVar, runtime_checkable

from roboneuron.contract.action import Action, ActionChunk
from roboneuron.contract.arrays import F64
from roboneuron.contract.motion import Hold, JointCommand, Posture, RobotState
from roboneuron.contract.observation import Frame, JointSample, Observation, Pose
from roboneuron.contract.space import ControlSpace

M = TypeVar("M")
Model = TypeVar("Model", contravariant=True)
"""Type that the backends of a model family pass to `Runtime.load`."""
Request = TypeVar("Request", contravariant=True)
"""Type that they pass to `Runtime.run`."""
Answer = TypeVar("Answer", covariant=True)
"""Type that `Runtime.run` returns."""
Decoder = TypeVar("Decoder", covariant=True)
"""Type that a runtime passes to `Acceleration.apply`."""
Accelerated = TypeVar("Accelerated", contravariant=True)
"""Type that an acceleration accepts there: the same one, or a part of it."""


class Topics(Protocol):
    """Access of a plugin to the ROS graph: only topics under the robot's namespace.

    Passed to perception sources and robot drivers. Message classes are ordinary rosidl classes;
    callbacks run on the host's executor thread and must return quickly. A name that begins with a
    slash is absolute.
    """

    def subscribe(
        self,
        topic: str,
        message_type: type[M],
        callback: Callable[[M], None],
        *,
        best_effort: bool = False,
    ) -> None:
        """Call `callback` with every message (reliable, depth 1: only the newest is kept) until the
        host closes.

        With `best_effort` it also matches best-effort publishers, as many camera drivers are, and
        stays reliable towards the others. Called from `open`, on the host's executor thread.
        """

    def advertise(self, topic: str, message_type: type[M]) -> Callable[[M], None]:
        """Return a function that publishes on `topic` (reliable, depth 1); callable from any
        thread.
        """

    def publisher_types(self, topic: str) -> tuple[str, ...]:
        """Message type ("package/msg/Name") of each publisher of `topic` discovered so far; from
        any thread.
        """

    def now_ns(self) -> int:
        """ROS time [ns], for stamps."""


@runtime_checkable
class Backend(Protocol):
    """Policy from images to actions. Built as `target(config, runtime=..., acceleration=...)`; used
    from one worker thread.

    `runtime` and `acceleration` are None unless the descriptor declares them.
    """

    def load(self) -> None:
        """Read weights, warm up. Called once, during `configure`, before the first `predict`.

        Raises:
            CheckpointError, ConfigurationError, MissingDependencyError: the process reports the
                error and stays unconfigured.
        """

    def predict(self, observation: Observation) -> ActionChunk:
        """Return the next actions in the contract's units and frame.

        Raises:
            UngroundedError: it cannot act on this observation; nothing is published and the status
                contains the reason.
            UnsafeError: the model produced non-finite values, or the observation contains some;
                nothing is published.
            InvalidInputError: a frame or a part of the state that the descriptor declares is
                missing.
            StateError: before `load` or after `close`.
        """

    def reset(self) -> None:
        """Discard the state of the episode; called on activate and whenever the instruction
        changes.
        """

    def close(self) -> None:
        """Release everything; may be called twice and before `load`."""


@runtime_checkable
class Runtime(Protocol[Model, Request, Answer, Decoder]):
    """Executes a model family's decoder for a backend, in the same process or on a server. Built as
    `target(config)`.

    The types of models and requests are agreed between the packages of a model family, which bind
    them here (`Runtime[MyModel, MyRequest, MyAnswer, MyDecoder]`); the descriptor's `families`
    names them and planning matches them.
    """

    def load(self, model: Model, acceleration: Acceleration[Decoder] | None = None) -> None:
        """Load the model (in process: read its weights; served: connect to the server and check its
        model).
        """

    def run(self, request: Request) -> Answer:
        """Execute one request of the family; blocks until the answer or the request's deadline.

        Raises:
            StateError: before `load` or after `close`.
        """

    def abort(self) -> None:
        """Cancel a `run` in progress, from another thread; no effect without one."""

    def close(self) -> None:
        """Release everything; may be called twice and before `load`."""


@runtime_checkable
class Acceleration(Protocol[Accelerated]):
    """A named preset that changes how a loaded model is executed. Built as `target(config)`."""

    def apply(self, decoder: Accelerated) -> None:
        """Install the preset into a decoder of a runtime that has the capability the descriptor
        requires.

        Raises:
            InvalidInputError: the decoder is of a kind that the preset does not know.
        """


AnyRuntime: TypeAlias = Runtime[Never, Never, object, object]
"""A runtime of an unknown family: it can be passed on, aborted and closed, but not used."""
AnyAcceleration: TypeAlias = Acceleration[Never]
"""An acceleration of an unknown family."""


@runtime_checkable
class PerceptionSource(Protocol):
    """Produces camera frames. Built as `target(config, topics, cameras)`: `cameras` are the
    profiles of the cameras to serve.
    """

    def open(self) -> None:
        """Acquire the device. Raises NotReadyError or ConfigurationError with what to do."""

    def read(self, timeout_s: float) -> Frame:
        """Return the next frame, of any of the cameras; its image must not be modified afterwards.

        Raises:
            NotReadyError: none came within `timeout_s`.
            StateError: before `open` or after `close`.
        """

    def close(self) -> None:
        """Release the device; may be called twice and before `open`."""


@runtime_checkable
class Controller(Protocol):
    """Pure computation from action and measured joints to a joint command. Built as `target(config,
    profile)`.
    """

    def load(self) -> None:
        """Parse the robot description. Raises ConfigurationError."""

    def forward(self, joints: JointSample) -> Pose:
        """TCP pose in the base frame for measured joints. Raises UnsafeError for missing or
        non-finite joints.
        """

    def compute(self, action: Action, joints: JointSample, step_s: float) -> JointCommand | Hold:
        """Return the command to execute within `step_s`, or the reason to hold. Never raises for
        invalid numbers.
        """

    def close(self) -> None:
        """Release everything; may be called twice."""


@runtime_checkable
class SpaceController(Protocol):
    """Additional interface of a controller whose descriptor names `spaces` other than
    `ee_delta`.
    """

    def execute(
        self, space: ControlSpace, row: F64, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        """Return the command to execute within `step_s`, or the reason to hold. Never raises for
        invalid numbers.

        Args:
            space: the robot's own space of that kind, see `robot_space`; never `joint_delta`.
            row: float64 (n,), checked by `ControlSpace.check`.
            joints: at the end of the command in progress, so that velocities add up without loss;
                the measured joints without one.
            step_s: time the row is meant for [s].
        """


@runtime_checkable
class SeveralArms(Protocol):
    """Additional interface of a controller for robots whose profile names `arms`."""

    def poses(self, joints: JointSample) -> tuple[Pose, ...]:
        """TCP pose of each arm in the base frame, in the order of the profile's `arms`.

        The first is the result of `Controller.forward`. Raises UnsafeError likewise.
        """


@runtime_checkable
class PostureInspector(Protocol):
    """Optional interface of a controller, needed for limits on singularities and collisions.

    The control module calls it for every command; the server calls another instance for joint
    motions.
    """

    def inspect(self, joints: JointSample) -> Posture:
        """Return the properties of a measured or planned posture, using the `collision` of the
        profile it was built with.

        Joints other than the arm's (a gripper's) are used if `joints` names them. Raises
        UnsafeError as `Controller.forward`.
        """


@runtime_checkable
class RobotDriver(Protocol):
    """Moves one robot. Built as `target(config, profile, topics)`; called from the robot module's
    threads.

    The driver of a simulation whose time passes only while commands are carried out has the
    attribute `waits_for_commands`, which is True: no command is late there.
    """

    def open(self) -> None:
        """Connect or start the simulation. Raises NotReadyError or ConfigurationError."""

    def read(self) -> RobotState:
        """Return the newest measured state without blocking for over a millisecond. Raises
        StateError unless open.
        """

    def send(self, command: JointCommand) -> JointCommand:
        """Start moving; return the command as sent after the driver's own limits. Raises
        InvalidInputError.
        """

    def hold(self) -> None:
        """Stop the robot at its present posture."""

    def close(self) -> None:
        """Stop and disconnect; may be called twice and before `open`."""


@runtime_checkable
class LookaheadDriver(Protocol):
    """Additional interface of a driver whose robot accepts commands ahead of time, as trajectory
    controllers do.
    """

    def send_ahead(self, command: JointCommand, planned: Sequence[JointCommand]) -> JointCommand:
        """Start moving as `send`; the robot continues with `planned` unless another call replaces
        it.

        Any later `send`, `send_ahead` or `hold` replaces the rest. The driver bounds how long the
        robot moves by itself, and may leave out the rest.

        Args:
            command: the first command.
            planned: within the limits; each begins at the end of the previous one.

        Returns:
            `command` as sent. Raises as `send`.
        """
