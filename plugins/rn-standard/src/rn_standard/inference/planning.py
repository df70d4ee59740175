"""Does this combination of backend, runtime, acceleration and cameras fit the robot? Answered from
descriptors alone, in one sentence, before anything heavy is imported.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

from rn_standard.inference.agreement import agree_on_space
from rn_standard.inference.instruction_text import check_instruction
from roboneuron import (
    AccelerationSpec,
    BackendSpec,
    CheckpointError,
    DriverSpec,
    InvalidInputError,
    PlanningError,
    RobotSpec,
    RuntimeSpec,
    Spec,
)
from roboneuron.feature import Config, ModuleKind, Plan, Registry, loading
from roboneuron.node import find_robot

CHECKPOINT_START_S = 900.0
"""Longest start of a policy with a checkpoint: 15 GB from a slow disk, and the warm-up of a large
model, take several minutes.
"""
_EMPTY: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True, kw_only=True, slots=True)
class Policy:
    """A policy that fits a robot, resolved to descriptors.

    Attributes:
        robot, driver: what it moves.
        backend: the policy itself.
        runtime: the one asked for, or the backend's default; None when the backend takes none.
        acceleration: None when not asked for.
        cameras: camera name by role, for every role the backend needs and each optional one the
            robot has.
    """

    robot: RobotSpec
    driver: DriverSpec
    backend: BackendSpec
    runtime: RuntimeSpec | None
    acceleration: AccelerationSpec | None
    cameras: Mapping[str, str]

    @property
    def takes_checkpoint(self) -> bool:
        """Whether the backend needs a checkpoint, or has an option for one; raises as
        `load_options_model`.
        """
        if self.backend.needs_checkpoint:
            return True
        model = loading.load_options_model(self.backend)
        return model is not None and "checkpoint" in model.model_fields


def find_policy(
    registry: Registry,
    *,
    robot: str,
    driver: str,
    backend: str,
    runtime: str | None = None,
    acceleration: str | None = None,
    cameras: Mapping[str, str] = _EMPTY,
    is_driver_elsewhere: bool = False,
    is_elsewhere: bool = False,
) -> Policy:
    """Return the policy of these names.

    Args:
        registry: what is installed.
        robot, driver, backend: names.
        runtime: None for the backend's default.
        acceleration: None for none.
        cameras: camera name by role, where the robot's own roles are not to be used.
        is_driver_elsewhere: the driver runs under another interpreter: modules that it needs may be
            absent here.
        is_elsewhere: likewise of the backend, its runtime and acceleration.

    Raises:
        ConfigurationError: a name is not installed or cannot be used.
        PlanningError: the parts do not fit; the message says which two and what would.
    """
    robot_spec, driver_spec = find_robot(registry, robot, driver, is_elsewhere=is_driver_elsewhere)
    spec = registry.get(BackendSpec, backend, elsewhere=is_elsewhere)
    _check_action_width(spec, robot_spec)
    chosen = _resolve_cameras(spec, robot_spec, cameras)
    runtime_spec = _resolve_runtime(registry, spec, runtime, is_elsewhere)
    acceleration_spec = None
    if acceleration:
        acceleration_spec = registry.get(AccelerationSpec, acceleration, elsewhere=is_elsewhere)
        _check_acceleration(registry, acceleration_spec, spec, runtime_spec)
    return Policy(
        robot=robot_spec,
        driver=driver_spec,
        backend=spec,
        runtime=runtime_spec,
        acceleration=acceleration_spec,
        cameras=MappingProxyType(chosen),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class InferencePlan(Plan):
    """A module of this feature, see `roboneuron.feature.Plan`."""

    policy: Policy

    @property
    def options(self) -> Mapping[str, object]:
        """Of the backend, with its checkpoint."""
        section, options = self.config.inference, self.config.options(self.plugin)
        if section is None or section.checkpoint is None:
            return options
        return {**options, "checkpoint": section.checkpoint}

    @property
    def others(self) -> tuple[Spec, ...]:
        """Runtime and acceleration."""
        parts = (self.policy.runtime, self.policy.acceleration)
        return tuple(part for part in parts if part is not None)

    def checked(self, registry: Registry) -> InferencePlan:
        """See `Plan.checked`.

        Raises:
            InvalidInputError: the instruction is none, or a checkpoint is missing.
            CheckpointError: the checkpoint's path does not exist, or the backend takes none.
            PlanningError: the space of the backend does not fit, see `agree_on_space`.
        """
        section = self.config.inference
        assert section is not None
        if section.instruction:
            check_instruction(section.instruction)
        plan = self._with_checkpoint()
        is_here = section.python is None and self.config.robot.python is None
        # the module does it again, where its own packages are
        if is_here and self.policy.backend.space is not None:
            agree_on_space(
                registry, self.policy.backend, plan.options, self.robot.name, self.config.control
            )
        return plan

    def _with_checkpoint(self) -> InferencePlan:
        """The plan with an absolute path, for the module may run in another working directory, and
        with the time that a large model needs.
        """
        backend, section = self.policy.backend, self.config.inference
        assert section is not None
        named = section.checkpoint or self.config.options(self.plugin).get("checkpoint")
        if named is None:
            if backend.needs_checkpoint:
                raise InvalidInputError(
                    f"Backend {backend.name!r} needs a checkpoint.",
                    hint="Name the directory of the model's files in `checkpoint`.",
                    path="checkpoint",
                )
            return self
        if not self.policy.takes_checkpoint:
            raise CheckpointError(
                f"Backend {backend.name!r} takes no checkpoint, but {named!r} was named."
            )
        path = Path(str(named)).expanduser()
        if not path.exists():
            raise CheckpointError(
                f"The checkpoint {str(named)!r} does not exist.",
                hint=f"Looked for {path.absolute()} on the server's host.",
            )
        checkpoint = str(path.absolute())
        usual_s = max(CHECKPOINT_START_S, self.config.supervisor.start_timeout_s)
        told = {
            "checkpoint": checkpoint,
            "start_timeout_s": usual_s
            if section.start_timeout_s is None
            else section.start_timeout_s,
        }
        update = {"inference": section.model_copy(update=told)}
        return replace(
            self,
            config=self.config.model_copy(update=update),
            names={**self.names, "checkpoint": checkpoint},
        )

    def check_beside(self, running: Mapping[ModuleKind, Config]) -> None:
        """See `Plan.check_beside`.

        Raises:
            InvalidInputError: the source of images does not serve all cameras of the backend.
        """
        section = running["perception"].perception if "perception" in running else None
        if section is None or not section.cameras:
            return
        backend = self.policy.backend
        needed = [self.policy.cameras[role] for role in backend.cameras]
        absent = [name for name in needed if name not in section.cameras]
        if absent:
            raise InvalidInputError(
                f"Backend {backend.name!r} needs the camera {', '.join(absent)}, "
                f"but perception serves only {', '.join(section.cameras)}.",
                hint="Let perception serve all cameras, or name others in `cameras`.",
            )


def plan_inference(config: Config, registry: Registry) -> InferencePlan:
    """The plan of `[inference]`; raises as `find_policy`."""
    section, robot = config.inference, config.robot
    assert section is not None
    policy = find_policy(
        registry,
        robot=robot.name,
        driver=robot.driver,
        **section.model_dump(include={"backend", "runtime", "acceleration", "cameras"}),
        is_driver_elsewhere=robot.python is not None,
        is_elsewhere=section.python is not None,
    )
    names = {
        "backend": section.backend,
        "checkpoint": section.checkpoint or "",
        "runtime": policy.runtime.name if policy.runtime else "",
        "acceleration": policy.acceleration.name if policy.acceleration else "",
        "cameras": ", ".join(f"{role}={camera}" for role, camera in policy.cameras.items()),
    }
    needs_state = policy.backend.needs_state
    return InferencePlan(
        kind="inference",
        config=config,
        robot=policy.robot,
        driver=policy.driver,
        spec=policy.backend,
        names={key: name for key, name in names.items() if name},
        inputs=("robot", "perception", "control") if needs_state else ("perception",),
        policy=policy,
    )


def _listed(names: Iterable[object]) -> str:
    return ", ".join(map(str, names)) or "none"


def _require(fits: bool, otherwise: str) -> None:
    if not fits:
        raise PlanningError(otherwise)


def _check_action_width(backend: BackendSpec, robot: RobotSpec) -> None:
    width = backend.action_space.width
    _require(
        bool(robot.action_widths),
        f"Robot {robot.name!r} executes no model actions, so backend {backend.name!r} cannot "
        "drive it.",
    )
    # a backend that declares its channels is compared by their names: `agree_on_space`
    _require(
        backend.space is not None or width in robot.action_widths,
        f"Backend {backend.name!r} yields actions of width {width}, "
        f"but robot {robot.name!r} executes widths {_listed(robot.action_widths)}.",
    )


def _resolve_cameras(
    backend: BackendSpec, robot: RobotSpec, cameras: Mapping[str, str]
) -> dict[str, str]:
    known = [c.name for c in robot.cameras]
    for role, name in cameras.items():
        _require(
            name in known,
            f"Camera {name!r} for role {role!r} is unknown; robot {robot.name!r} has: "
            f"{_listed(known)}.",
        )
    roles = (*backend.cameras, *backend.optional_cameras)
    for role in cameras:
        _require(
            role in roles,
            f"Backend {backend.name!r} uses no camera role {role!r}; it uses: {_listed(roles)}.",
        )
    # of several cameras with one role the first
    found = {camera.role: camera.name for camera in reversed(robot.cameras)} | dict(cameras)
    absent = [role for role in backend.cameras if role not in found]
    has = _listed(f"{c.name} (role {c.role})" for c in robot.cameras)
    _require(
        not absent,
        f"Backend {backend.name!r} needs a camera of role {_listed(absent)}, but robot "
        f"{robot.name!r} has: {has}.",
    )
    return {role: found[role] for role in roles if role in found}


def _resolve_runtime(
    registry: Registry, backend: BackendSpec, name: str | None, is_elsewhere: bool
) -> RuntimeSpec | None:
    fitting = [
        r.name
        for r in registry.specs(RuntimeSpec).values()
        if backend.family and backend.family in r.families
    ]
    wanted = name or backend.default_runtime
    if not wanted:
        _require(
            not backend.runtimes_required,
            f"Backend {backend.name!r} needs a runtime for the family {backend.family!r}; "
            f"installed ones that fit: {_listed(fitting)}.",
        )
        return None
    _require(
        bool(backend.family),
        f"Backend {backend.name!r} takes no runtime, but {wanted!r} was asked for.",
    )
    runtime = registry.get(RuntimeSpec, wanted, elsewhere=is_elsewhere)
    _require(
        backend.family in runtime.families,
        f"Runtime {wanted!r} executes the families {_listed(runtime.families)}, but backend "
        f"{backend.name!r} is of family {backend.family!r}; installed ones that fit: "
        f"{_listed(fitting)}.",
    )
    return runtime


def _check_acceleration(
    registry: Registry,
    acceleration: AccelerationSpec,
    backend: BackendSpec,
    runtime: RuntimeSpec | None,
) -> None:
    """The capability is offered by what executes the decoder: the runtime, or the backend when it
    runs without one.
    """
    _require(
        bool(backend.family)
        and (not acceleration.families or backend.family in acceleration.families),
        f"Acceleration {acceleration.name!r} knows the families "
        f"{_listed(acceleration.families)}, "
        f"but backend {backend.name!r} is of family {backend.family or 'none'!r}.",
    )
    word = acceleration.capability
    able = [
        r.name
        for r in registry.specs(RuntimeSpec).values()
        if backend.family in r.families and (not word or word in r.capabilities)
    ]
    if runtime is None:
        _require(
            bool(word) and word in backend.capabilities,
            f"Acceleration {acceleration.name!r} needs a runtime that offers "
            f"{word or 'a decoder'!r}, but backend {backend.name!r} was to run without one; "
            f"installed ones that fit: {_listed(able)}.",
        )
        return
    where = "runs the model in another process and " if runtime.served else ""
    _require(
        not word or word in runtime.capabilities,
        f"Acceleration {acceleration.name!r} needs the capability {word!r}, but runtime "
        f"{runtime.name!r} {where}offers {_listed(runtime.capabilities)}; installed ones that "
        f"fit: {_listed(able)}.",
    )
