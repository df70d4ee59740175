"""A simulated base, stepped explicitly, so that tests and benchmarks run faster than real time; the
driver runs it in real time.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType

from rn_robot_bases.drivetrain import JointValues
from rn_robot_bases.platform import Platform, in_engine
from rn_robot_bases.profile import check_twist
from rn_robot_bases.world import BaseWorld
from rn_simulation.engine import Engine, EngineChoice, choose_engine
from rn_simulation.planar_motion import BaseVelocity, PlanarPose, integrate
from roboneuron import StateError

STEP_S = 1.0 / 240.0
"""Physics step [s]."""
_SETTLING_STEPS = 120
_STILL = BaseVelocity(linear_x=0.0, linear_y=0.0, angular_z=0.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class BaseState:
    """State of a base at one time.

    Attributes:
        time_s: simulated time since `open`.
        joint_position, joint_velocity: values of every wheel and hinge [rad, rad/s], by name.
        odometry: pose from its wheel encoders, in the frame of its start.
        velocity: velocity from its wheel encoders, in its own frame.
        true_pose: true pose; for judging and tests only.
        setpoint: current setpoint of speed [m/s] and turning rate [rad/s].
        motion: "driving", "standing", or "stopping: ..." with the reason.
    """

    time_s: float
    joint_position: JointValues
    joint_velocity: JointValues
    odometry: PlanarPose
    velocity: BaseVelocity
    true_pose: PlanarPose
    setpoint: tuple[float, float]
    motion: str


class BaseSimulation:
    """One base on a flat floor with its motion controller, its deadman and its odometry; used from
    one thread.

    Use it as a context manager, or call `open` and `close`. The same calls give the same motion in
    one engine.
    """

    def __init__(
        self, platform: Platform, *, command_timeout_s: float = 0.5, engine: EngineChoice = "auto"
    ) -> None:
        """Choose platform and engine; the base brakes `command_timeout_s` (simulated) after the
        last command.

        Raises:
            ConfigurationError: the engine is not installed.
        """
        self.engine = choose_engine(engine)
        self.platform = in_engine(platform, self.engine)
        self._timeout_s = command_timeout_s
        self._world: BaseWorld | None = None
        self._reset()

    def _reset(self) -> None:
        self._steps = 0
        self._drivetrain = self.platform.drivetrain()
        self._odometry = PlanarPose()
        self._velocity = _STILL
        self._positions: JointValues = {}
        self._velocities: JointValues = {}
        self._command_s: float | None = None
        self._motion = "standing"

    def __enter__(self) -> BaseSimulation:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def open(self) -> None:
        """Build the world and let the base settle on its wheels. Raises StateError if it is already
        open.
        """
        if self._world is not None:
            raise StateError(f"The simulated {self.platform.name} is open already.")
        self._reset()
        self._world = _build_world(self.engine, self.platform, STEP_S)
        for _ in range(_SETTLING_STEPS):
            self._world.step(self._drivetrain.advance(STEP_S))
        self._positions = self._world.joint_positions()
        self._velocities = dict.fromkeys(self._positions, 0.0)

    def close(self) -> None:
        """Destroy the world; may be called twice and before `open`."""
        if self._world is not None:
            self._world.close()
            self._world = None

    def drive(self, linear_m_s: float, angular_rad_s: float) -> None:
        """Drive at this velocity until the next command, or until `command_timeout_s` has passed.

        Raises:
            RefusedError: the platform cannot do that; the velocity stays unchanged.
        """
        check_twist(self.platform, linear_m_s, angular_rad_s)
        self._drivetrain.aim(linear_m_s, angular_rad_s)
        self._command_s = self.time_s
        self._motion = "driving" if linear_m_s or angular_rad_s else "standing"

    def hold(self, reason: str = "held") -> None:
        """Brake to a standstill."""
        self._drivetrain.halt()
        self._command_s = None
        self._motion = f"stopping: {reason}"

    def step(self, count: int = 1) -> None:
        """Advance by `count` physics steps of `STEP_S`. Raises StateError unless open."""
        world = self._opened()
        for _ in range(count):
            if self._command_s is not None and self.time_s - self._command_s > self._timeout_s:
                self.hold(f"no command for {self._timeout_s:g} s")
            world.step(self._drivetrain.advance(STEP_S))
            self._steps += 1
            positions = world.joint_positions()
            self._velocities = {n: (p - self._positions[n]) / STEP_S for n, p in positions.items()}
            self._positions = positions
            self._velocity = self._drivetrain.measure(self._velocities, positions)
            self._odometry = integrate(self._odometry, self._velocity, STEP_S)

    def run(self, linear_m_s: float, angular_rad_s: float, duration_s: float) -> BaseState:
        """Drive for `duration_s`, with commands at a client's rate; return the final state."""
        for _ in range(round(duration_s / STEP_S)):
            self.drive(linear_m_s, angular_rad_s)
            self.step()
        return self.state()

    @property
    def time_s(self) -> float:
        """Simulated time since `open` [s]."""
        return self._steps * STEP_S

    def state(self) -> BaseState:
        """Complete current state. Raises StateError unless open."""
        return BaseState(
            time_s=self.time_s,
            joint_position=self._positions,
            joint_velocity=self._velocities,
            odometry=self._odometry,
            velocity=self._velocity,
            true_pose=self._opened().base_pose(),
            setpoint=self._drivetrain.setpoint,
            motion=self._motion,
        )

    def _opened(self) -> BaseWorld:
        if self._world is None:
            raise StateError(
                f"The simulated {self.platform.name} is not open.",
                hint="Call open() or use it as a context manager.",
            )
        return self._world


def _build_world(engine: Engine, platform: Platform, step_s: float) -> BaseWorld:
    """Build a world with `platform` in `engine`."""
    if engine == "mujoco":
        from rn_robot_bases.mujoco_world import MujocoBaseWorld  # heavy, and perhaps not installed

        return MujocoBaseWorld(platform, step_s)
    from rn_robot_bases.pybullet_world import PybulletBaseWorld  # likewise

    return PybulletBaseWorld(platform, step_s)
