"""Does this combination fit? Answered from descriptors alone, in one sentence, before anything
heavy is imported.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TypeVar

from roboneuron.errors import PlanningError
from roboneuron.plugins import availability
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import (
    AccelerationSpec,
    BackendSpec,
    ControllerSpec,
    DriverSpec,
    PerceptionSpec,
    RobotSpec,
    RuntimeSpec,
    Spec,
)

S = TypeVar("S", bound=Spec)
_EMPTY: Mapping[str, str] = MappingProxyType({})


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """A combination that fits, resolved to descriptors.

    Attributes:
        robot, driver: what moves.
        perception, controller, backend: None when not asked for.
        runtime: the one asked for, or the backend's default; None when the backend takes none.
        acceleration: None when not asked for.
        cameras: camera name by role, for every role the backend needs and each optional one the
            robot has.
    """

    robot: RobotSpec
    driver: DriverSpec
    perception: PerceptionSpec | None = None
    controller: ControllerSpec | None = None
    backend: BackendSpec | None = None
    runtime: RuntimeSpec | None = None
    acceleration: AccelerationSpec | None = None
    cameras: Mapping[str, str] = field(default_factory=dict)

    @property
    def takes_checkpoint(self) -> bool:
        """Whether the backend needs a checkpoint, or has an option for one; raises as
        `load_options_model`.
        """
        if self.backend is None or self.backend.needs_checkpoint:
            return self.backend is not None
        from roboneuron.plugins.loading import load_options_model  # heavy

        model = load_options_model(self.backend)
        return model is not None and "checkpoint" in model.model_fields


def check_plan(
    registry: Registry,
    *,
    robot: str,
    driver: str,
    perception: str | None = None,
    controller: str | None = None,
    backend: str | None = None,
    runtime: str | None = None,
    acceleration: str | None = None,
    cameras: Mapping[str, str] = _EMPTY,
    elsewhere: Collection[str] = (),
) -> Plan:
    """Return the plan for these names.

    Args:
        registry: what is installed.
        robot, driver, perception, controller, backend, runtime, acceleration: names; None for "not
            wanted", except that the backend's default runtime is taken when `runtime` is None.
        cameras: camera name by role, where the robot's own roles are not to be used.
        elsewhere: which of "driver", "perception", "controller" and "backend" (with its runtime and
            acceleration) run under another interpreter: modules that they need may be absent here.

    Raises:
        ConfigurationError: a name is not installed or cannot be used.
        PlanningError: the parts do not fit; the message says which two and what would.
    """
    robot_spec = registry.get(RobotSpec, robot)
    driver_spec = _check_driver(robot_spec, driver, "driver" in elsewhere)

    def find(kind: type[S], name: str | None, part: str) -> S | None:
        return registry.get(kind, name, elsewhere=part in elsewhere) if name else None

    perception_spec = find(PerceptionSpec, perception, "perception")
    controller_spec = find(ControllerSpec, controller, "controller")
    backend_spec = find(BackendSpec, backend, "backend")
    if perception_spec is not None:
        _check_perception(perception_spec, robot_spec, driver_spec)
    if controller_spec is not None:
        _require(
            robot_spec.robot_kind in controller_spec.robot_kinds,
            f"Controller {controller!r} moves robots of kind "
            f"{_listed(controller_spec.robot_kinds)}, "
            f"but {robot!r} is of kind {robot_spec.robot_kind!r}.",
        )
    runtime_spec = acceleration_spec = None
    if backend_spec is None:
        for kind, name in (("runtime", runtime), ("acceleration", acceleration)):
            _require(not name, f"The {kind} {name!r} has nothing to execute; name a backend too.")
        chosen = _chosen_cameras(robot_spec, cameras)
    else:
        _check_action_width(backend_spec, robot_spec)
        chosen = _resolve_cameras(backend_spec, robot_spec, cameras)
        runtime_spec = _resolve_runtime(registry, backend_spec, runtime, "backend" in elsewhere)
        acceleration_spec = find(AccelerationSpec, acceleration, "backend")
        if acceleration_spec is not None:
            _check_acceleration(registry, acceleration_spec, backend_spec, runtime_spec)
    return Plan(
        robot=robot_spec,
        driver=driver_spec,
        perception=perception_spec,
        controller=controller_spec,
        backend=backend_spec,
        runtime=runtime_spec,
        acceleration=acceleration_spec,
        cameras=MappingProxyType(chosen),
    )


def _listed(names: Iterable[object]) -> str:
    return ", ".join(map(str, names)) or "none"


def _require(fits: bool, otherwise: str) -> None:
    if not fits:
        raise PlanningError(otherwise)


def _check_driver(robot: RobotSpec, name: str, is_elsewhere: bool) -> DriverSpec:
    driver = robot.driver(name)
    if driver is None:
        raise PlanningError(
            f"Robot {robot.name!r} has no driver {name!r}; choose one of: "
            f"{_listed(d.name for d in robot.drivers)}."
        )
    absent = availability.missing(driver.requires)
    _require(
        not absent or is_elsewhere,
        f"Driver {name!r} of robot {robot.name!r} cannot be used: {availability.explain(absent)}",
    )
    return driver


def _check_perception(perception: PerceptionSpec, robot: RobotSpec, driver: DriverSpec) -> None:
    _require(
        not perception.robots or robot.name in perception.robots,
        f"Perception {perception.name!r} serves only the robots {_listed(perception.robots)}, "
        f"not {robot.name!r}.",
    )
    _require(
        not perception.drivers or driver.name in perception.drivers,
        f"Perception {perception.name!r} works only with the drivers "
        f"{_listed(perception.drivers)}, not with {driver.name!r} of robot {robot.name!r}.",
    )


def _check_action_width(backend: BackendSpec, robot: RobotSpec) -> None:
    width = backend.action_space.width
    _require(
        bool(robot.action_widths),
        f"Robot {robot.name!r} executes no model actions, so backend {backend.name!r} cannot "
        "drive it.",
    )
    # a backend that declares its channels is compared by their names: `FeatureSpec.module_check`
    _require(
        backend.space is not None or width in robot.action_widths,
        f"Backend {backend.name!r} yields actions of width {width}, "
        f"but robot {robot.name!r} executes widths {_listed(robot.action_widths)}.",
    )


def _chosen_cameras(robot: RobotSpec, cameras: Mapping[str, str]) -> dict[str, str]:
    known = [c.name for c in robot.cameras]
    for role, name in cameras.items():
        _require(
            name in known,
            f"Camera {name!r} for role {role!r} is unknown; robot {robot.name!r} has: "
            f"{_listed(known)}.",
        )
    return dict(cameras)


def _resolve_cameras(
    backend: BackendSpec, robot: RobotSpec, cameras: Mapping[str, str]
) -> dict[str, str]:
    chosen = _chosen_cameras(robot, cameras)
    roles = (*backend.cameras, *backend.optional_cameras)
    for role in chosen:
        _require(
            role in roles,
            f"Backend {backend.name!r} uses no camera role {role!r}; it uses: {_listed(roles)}.",
        )
    # of several cameras with one role the first
    found = {camera.role: camera.name for camera in reversed(robot.cameras)} | chosen
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
