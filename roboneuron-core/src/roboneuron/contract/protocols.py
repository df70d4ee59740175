"""How plugins behave: small protocols, pure constructors, `load`/`open` do the work, `close` is
idempotent.

Each class named by a descriptor's `target` is called as `target(config, ...)` with the arguments
its protocol names; `config` is an instance of the pydantic model that the descriptor's `config`
names (or None when it names none).
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
"""What a model family's backends give to `Runtime.load`."""
Request = TypeVar("Request", contravariant=True)
"""What they give to `Runtime.run`."""
Answer = TypeVar("Answer", covariant=True)
"""What `Runtime.run` returns."""
Decoder = TypeVar("Decoder", covariant=True)
"""What a runtime gives to `Acceleration.apply`."""
Accelerated = TypeVar("Accelerated", contravariant=True)
"""What an acceleration takes there: the same type, or a part of it."""


class Topics(Protocol):
    """What the host process lends a plugin of the ROS graph: nothing but topics under the robot's
    namespace.

    Handed to perception sources and robot drivers. Message classes are ordinary rosidl classes;
    callbacks run on the host's executor thread and must return quickly. A name that begins with a
    slash is taken as it is.
    """

    def subscribe(
        self,
        topic: str,
        message_type: type[M],
        callback: Callable[[M], None],
        *,
        best_effort: bool = False,
    ) -> None:
        """Call `callback` with every message (reliable, depth 1: the newest wins) until the host
        closes.

        With `best_effort` it hears publishers that are best effort too, as many camera drivers are,
        and stays reliable towards those that are not. Called from `open`, on the host's executor
        thread.
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
    """Image -> action. Built as `target(config, runtime=..., acceleration=...)`; used from one
    worker thread.

    `runtime` and `acceleration` are None unless the descriptor declares that it takes them.
    """

    def load(self) -> None:
        """Read weights, warm up. Called once, during `configure`, before the first `predict`.

        Raises:
            CheckpointError, ConfigurationError, MissingDependencyError: the process reports it and
                stays unconfigured.
        """

    def predict(self, observation: Observation) -> ActionChunk:
        """Return what to do next, already in the contract's units and frame.

        Raises:
            UngroundedError: cannot act on this observation; nothing is published and the status
                says why.
            UnsafeError: the model produced non-finite values, or the observation holds some;
                nothing is published.
            InvalidInputError: a frame or a part of the state that the descriptor declares is
                absent.
            StateError: before `load` or after `close`.
        """

    def reset(self) -> None:
        """Forget the episode: called on activate and whenever the instruction changes."""

    def close(self) -> None:
        """Release everything; may be called twice and before `load`."""


@runtime_checkable
class Runtime(Protocol[Model, Request, Answer, Decoder]):
    """Executes a model family's decoder for a backend, in process or served. Built as
    `target(config)`.

    What `load` takes and what requests look like is agreed per model family between the packages
    concerned, in types that a package of the family binds here (`Runtime[MyModel, MyRequest,
    MyAnswer, MyDecoder]`); the descriptor's `families` names them and planning matches them.
    """

    def load(self, model: Model, acceleration: Acceleration[Decoder] | None = None) -> None:
        """Take the model (in process: read its weights; served: reach the server and check what it
        serves).
        """

    def run(self, request: Request) -> Answer:
        """Execute one request of the family; blocks until the answer or the request's deadline.

        Raises:
            StateError: before `load` or after `close`.
        """

    def abort(self) -> None:
        """Give up a `run` in progress, from another thread; harmless when there is none."""

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
"""A runtime of a family that is not known here: it can be handed on, aborted and closed, but not
used.
"""
AnyAcceleration: TypeAlias = Acceleration[Never]
"""Likewise an acceleration."""


@runtime_checkable
class PerceptionSource(Protocol):
    """Produces camera frames. Built as `target(config, topics, cameras)`: `cameras` are the
    profiles to serve.
    """

    def open(self) -> None:
        """Acquire the device. Raises NotReadyError or ConfigurationError with what to do."""

    def read(self, timeout_s: float) -> Frame:
        """Return the next frame, of any of the cameras; its image is not written to afterwards.

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
        """Return where to go within `step_s`, or why the robot should hold. Never raises for bad
        numbers.
        """

    def close(self) -> None:
        """Release everything; may be called twice."""


@runtime_checkable
class SpaceController(Protocol):
    """What a controller offers beside `Controller` when its descriptor names other `spaces` than
    `ee_delta`.
    """

    def execute(
        self, space: ControlSpace, row: F64, joints: JointSample, step_s: float
    ) -> JointCommand | Hold:
        """Return where to go within `step_s`, or why the robot should hold. Never raises for bad
        numbers.

        Args:
            space: the robot's own space of that kind, see `robot_space`; never `joint_delta`.
            row: float64 (n,), checked by `ControlSpace.check`.
            joints: where the command in progress ends, so that velocities add up without loss;
                the measured joints where none is in progress.
            step_s: time the row is meant for [s].
        """


@runtime_checkable
class SeveralArms(Protocol):
    """What a controller offers beside `Controller` for robots whose profile names `arms`."""

    def poses(self, joints: JointSample) -> tuple[Pose, ...]:
        """TCP pose of each arm in the base frame, in the order of the profile's `arms`.

        `Controller.forward` tells the first of them. Raises UnsafeError as it does.
        """


@runtime_checkable
class PostureInspector(Protocol):
    """What a controller may offer beside `Controller`, so that singularities and collisions can be
    limited.

    The control module asks it about every command; the server asks an instance of its own about
    joint motions.
    """

    def inspect(self, joints: JointSample) -> Posture:
        """Return what holds in a posture, measured or planned, by the `collision` of the profile it
        was built with.

        Joints beside the arm's (a gripper's) count where `joints` names them. Raises UnsafeError as
        `Controller.forward`.
        """


@runtime_checkable
class RobotDriver(Protocol):
    """Moves one robot. Built as `target(config, profile, topics)`; called from the robot module's
    threads.
    """

    def open(self) -> None:
        """Connect or start the simulation. Raises NotReadyError or ConfigurationError."""

    def read(self) -> RobotState:
        """Return the newest measured state without blocking for over a millisecond. Raises
        StateError unless open.
        """

    def send(self, command: JointCommand) -> JointCommand:
        """Start moving; returns what was really sent after the driver's own limits. Raises
        InvalidInputError.
        """

    def hold(self) -> None:
        """Stop where the robot is and stay there."""

    def close(self) -> None:
        """Stop and disconnect; may be called twice and before `open`."""


@runtime_checkable
class LookaheadDriver(Protocol):
    """What a driver offers beside `RobotDriver` when it can give its robot commands before their
    time, as trajectory controllers take them.
    """

    def send_ahead(self, command: JointCommand, planned: Sequence[JointCommand]) -> JointCommand:
        """Start moving as `send`; the robot goes on with `planned` by itself unless it is told
        otherwise.

        Any later `send`, `send_ahead` or `hold` replaces all that is left. The driver bounds how
        long the robot moves by itself, and may leave out the rest.

        Args:
            command: to start with.
            planned: within the limits; each begins where and when the one before ends.

        Returns:
            What was really sent of `command`. Raises as `send`.
        """
