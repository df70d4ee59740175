"""Compatibility check of backend, runtime, acceleration and cameras with the robot, from
descriptors alone, before anything heavy is imported.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

from roboneuron.config.models import Config
from roboneuron.errors import CheckpointError, ConfigurationError, InvalidInputError
from roboneuron.modules.inference.agreement import (
    SpaceAgreement,
    agree_with_control,
    check_same_space,
    declared_space,
)
from roboneuron.modules.inference.fitting import (
    check_acceleration,
    check_action_width,
    require,
    resolve_cameras,
    resolve_runtime,
)
from roboneuron.modules.inference.instruction_text import check_instruction
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import Plan, find_robot
from roboneuron.plugins import loading
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import (
    AccelerationSpec,
    BackendSpec,
    DriverSpec,
    RobotSpec,
    RuntimeSpec,
    Spec,
)

__all__ = ["ResolvedPolicy"]
"""Names that other distributions may use."""

CHECKPOINT_START_S = 900.0
"""Longest start of a policy with a checkpoint: reading 15 GB from a slow disk and the warm-up of a
large model take several minutes.
"""
_EMPTY: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True, kw_only=True, slots=True)
class ResolvedPolicy:
    """A policy that fits a robot, resolved to descriptors.

    Attributes:
        robot, driver: the robot and its driver.
        backend: the backend.
        runtime: the requested one, or the backend's default; None if the backend uses none.
        acceleration: None if not requested.
        cameras: camera name by role, for every required role and each optional one of the robot.
    """

    robot: RobotSpec
    driver: DriverSpec
    backend: BackendSpec
    runtime: RuntimeSpec | None
    acceleration: AccelerationSpec | None
    cameras: Mapping[str, str]

    @classmethod
    def of(
        cls,
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
    ) -> ResolvedPolicy:
        """Return the policy with these names.

        Args:
            registry: the installed plugins.
            robot, driver, backend: names.
            runtime: None for the backend's default.
            acceleration: None for none.
            cameras: camera name by role, instead of the robot's own roles.
            is_driver_elsewhere: the driver runs under another interpreter: modules that it needs
                may be absent here.
            is_elsewhere: the same for the backend, its runtime and acceleration.

        Raises:
            ConfigurationError: a name is not installed or unusable.
            PlanningError: the parts are incompatible; the message says which two and what would
                fit.
        """
        robot_spec, driver_spec = find_robot(
            registry, robot, driver, is_elsewhere=is_driver_elsewhere
        )
        spec = registry.get(BackendSpec, backend, elsewhere=is_elsewhere)
        check_action_width(spec, robot_spec)
        chosen = resolve_cameras(spec, robot_spec, cameras)
        runtime_spec = resolve_runtime(registry, spec, runtime, is_elsewhere)
        acceleration_spec = None
        if acceleration:
            acceleration_spec = registry.get(AccelerationSpec, acceleration, elsewhere=is_elsewhere)
            check_acceleration(registry, acceleration_spec, spec, runtime_spec)
        return cls(
            robot=robot_spec,
            driver=driver_spec,
            backend=spec,
            runtime=runtime_spec,
            acceleration=acceleration_spec,
            cameras=MappingProxyType(chosen),
        )

    @property
    def takes_checkpoint(self) -> bool:
        """True if the backend needs a checkpoint, or has an option for one; raises as
        `load_options_model`.
        """
        if self.backend.needs_checkpoint:
            return True
        model = loading.load_options_model(self.backend)
        return model is not None and "checkpoint" in model.model_fields


def find_policies(
    config: Config, registry: Registry, *, in_module: bool = False
) -> tuple[ResolvedPolicy, ResolvedPolicy | None]:
    """Return the policy of `[inference]`, and its fallback, if there is one.

    Args:
        config: configuration of the server or module.
        registry: the installed plugins.
        in_module: called in the process that runs the policies, so that all of their parts must be
            installed here; the driver runs elsewhere.

    Raises:
        ConfigurationError, PlanningError: as `ResolvedPolicy.of`, or the fallback equals the
            policy.
    """
    section, robot = config.inference, config.robot
    if section is None:
        raise ConfigurationError("The configuration has no [inference] section.")
    is_elsewhere = not in_module and section.python is not None
    find = partial(
        ResolvedPolicy.of,
        registry,
        robot=robot.name,
        driver=robot.driver,
        is_driver_elsewhere=in_module or robot.python is not None,
        is_elsewhere=is_elsewhere,
    )
    parts = section.model_dump(include={"backend", "runtime", "acceleration", "cameras"})
    policy = find(**parts)
    name = section.fallback
    if name is None:
        return policy, None
    require(
        name != section.backend,
        f"The fallback is {name!r} itself; name a policy that answers when that one does not.",
    )
    spec = registry.get(BackendSpec, name, elsewhere=is_elsewhere)
    roles = (*spec.cameras, *spec.optional_cameras)
    cameras = {role: camera for role, camera in section.cameras.items() if role in roles}
    return policy, find(backend=name, cameras=cameras)


@dataclass(frozen=True, kw_only=True, slots=True)
class InferencePlan(Plan):
    """Plan of an inference module, see `roboneuron.feature.Plan`.

    Attributes:
        policy: the first policy.
        fallback: the policy that acts while the first does not answer in time; None without one.
    """

    policy: ResolvedPolicy
    fallback: ResolvedPolicy | None = None

    @property
    def options(self) -> Mapping[str, object]:
        """Options of the backend, with its checkpoint."""
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
            InvalidInputError: the instruction is invalid, or a checkpoint is missing.
            CheckpointError: the checkpoint's path does not exist, or the backend uses none.
            PlanningError: the space of the backend does not fit, see `SpaceAgreement.of`.
        """
        section = self.config.inference
        assert section is not None
        if section.instruction:
            check_instruction(section.instruction)
        plan = self._with_checkpoint()
        is_here = section.python is None and self.config.robot.python is None
        # the module does it again, where its own packages are
        if is_here:
            self._check_spaces(registry, plan.options)
        return plan

    def _check_spaces(self, registry: Registry, options: Mapping[str, object]) -> None:
        """Check that control can execute the rows of the policy and of its fallback."""
        backend, second = self.policy.backend, self.fallback
        if backend.space is None and second is None:
            return
        robot, control = self.robot.name, self.config.control
        declared = declared_space(registry, backend, options, robot)
        if declared is None:  # its server reports it once the module is connected
            return
        agreed = agree_with_control(registry, backend, declared, robot, control)
        if second is not None:
            own = self.config.options(second.backend.name)
            other = SpaceAgreement.of(registry, second.backend, own, robot, control)
            check_same_space(agreed, other, second.backend.name)

    def _with_checkpoint(self) -> InferencePlan:
        """Return the plan with an absolute path, since the module may have another working
        directory, and with the start time for a large model.
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
        for policy in filter(None, (self.policy, self.fallback)):
            needed = [policy.cameras[role] for role in policy.backend.cameras]
            absent = [name for name in needed if name not in section.cameras]
            if absent:
                raise InvalidInputError(
                    f"Backend {policy.backend.name!r} needs the camera {', '.join(absent)}, "
                    f"but perception serves only {', '.join(section.cameras)}.",
                    hint="Let perception serve all cameras, or name others in `cameras`.",
                )


def plan_inference(config: Config, registry: Registry) -> InferencePlan:
    """The plan of `[inference]`; raises as `ResolvedPolicy.of`."""
    section = config.inference
    assert section is not None
    policy, fallback = find_policies(config, registry)
    names = {
        "backend": section.backend,
        "checkpoint": section.checkpoint or "",
        "runtime": policy.runtime.name if policy.runtime else "",
        "acceleration": policy.acceleration.name if policy.acceleration else "",
        "cameras": ", ".join(f"{role}={camera}" for role, camera in policy.cameras.items()),
        "fallback": section.fallback or "",
    }
    needs_state = any(one.backend.needs_state for one in (policy, fallback) if one is not None)
    return InferencePlan(
        kind="inference",
        config=config,
        robot=policy.robot,
        driver=policy.driver,
        spec=policy.backend,
        names={key: name for key, name in names.items() if name},
        inputs=("robot", "perception", "control") if needs_state else ("perception",),
        policy=policy,
        fallback=fallback,
    )
