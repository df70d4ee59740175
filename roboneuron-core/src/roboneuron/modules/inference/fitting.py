"""Compatibility checks of the parts of a policy with the robot and each other; see `planning`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from roboneuron.errors import PlanningError
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import AccelerationSpec, BackendSpec, RobotSpec, RuntimeSpec


def _listed(names: Iterable[object]) -> str:
    return ", ".join(map(str, names)) or "none"


def require(fits: bool, otherwise: str) -> None:
    """Raise PlanningError, with the sentence `otherwise`, if `fits` is false."""
    if not fits:
        raise PlanningError(otherwise)


def check_action_width(backend: BackendSpec, robot: RobotSpec) -> None:
    """Raise PlanningError if the robot cannot execute actions of the backend's width."""
    width = backend.action_space.width
    require(
        bool(robot.action_widths),
        f"Robot {robot.name!r} executes no model actions, so backend {backend.name!r} cannot "
        "drive it.",
    )
    # a backend that declares its channels is compared by their names: `SpaceAgreement.of`
    require(
        backend.space is not None or width in robot.action_widths,
        f"Backend {backend.name!r} yields actions of width {width}, "
        f"but robot {robot.name!r} executes widths {_listed(robot.action_widths)}.",
    )


def resolve_cameras(
    backend: BackendSpec, robot: RobotSpec, cameras: Mapping[str, str]
) -> dict[str, str]:
    """Return the camera name by role, for every required role and each optional one of the robot.

    Raises PlanningError for an unknown camera or role, or a missing one.
    """
    known = [c.name for c in robot.cameras]
    for role, name in cameras.items():
        require(
            name in known,
            f"Camera {name!r} for role {role!r} is unknown; robot {robot.name!r} has: "
            f"{_listed(known)}.",
        )
    roles = (*backend.cameras, *backend.optional_cameras)
    for role in cameras:
        require(
            role in roles,
            f"Backend {backend.name!r} uses no camera role {role!r}; it uses: {_listed(roles)}.",
        )
    # the first of several cameras with one role
    found = {camera.role: camera.name for camera in reversed(robot.cameras)} | dict(cameras)
    absent = [role for role in backend.cameras if role not in found]
    has = _listed(f"{c.name} (role {c.role})" for c in robot.cameras)
    require(
        not absent,
        f"Backend {backend.name!r} needs a camera of role {_listed(absent)}, but robot "
        f"{robot.name!r} has: {has}.",
    )
    return {role: found[role] for role in roles if role in found}


def resolve_runtime(
    registry: Registry, backend: BackendSpec, name: str | None, is_elsewhere: bool
) -> RuntimeSpec | None:
    """Return the runtime of that name, or the backend's default; None if it uses none. Raises
    PlanningError if it does not fit the backend's family.
    """
    fitting = [
        r.name
        for r in registry.specs(RuntimeSpec).values()
        if backend.family and backend.family in r.families
    ]
    wanted = name or backend.default_runtime
    if not wanted:
        require(
            not backend.runtimes_required,
            f"Backend {backend.name!r} needs a runtime for the family {backend.family!r}; "
            f"installed ones that fit: {_listed(fitting)}.",
        )
        return None
    require(
        bool(backend.family),
        f"Backend {backend.name!r} takes no runtime, but {wanted!r} was asked for.",
    )
    runtime = registry.get(RuntimeSpec, wanted, elsewhere=is_elsewhere)
    require(
        backend.family in runtime.families,
        f"Runtime {wanted!r} executes the families {_listed(runtime.families)}, but backend "
        f"{backend.name!r} is of family {backend.family!r}; installed ones that fit: "
        f"{_listed(fitting)}.",
    )
    return runtime


def check_acceleration(
    registry: Registry,
    acceleration: AccelerationSpec,
    backend: BackendSpec,
    runtime: RuntimeSpec | None,
) -> None:
    """Raise PlanningError if an acceleration does not fit.

    The capability is offered by the executor of the decoder: the runtime, or the backend if it runs
    without one.
    """
    require(
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
        require(
            bool(word) and word in backend.capabilities,
            f"Acceleration {acceleration.name!r} needs a runtime that offers "
            f"{word or 'a decoder'!r}, but backend {backend.name!r} was to run without one; "
            f"installed ones that fit: {_listed(able)}.",
        )
        return
    where = "runs the model in another process and " if runtime.served else ""
    require(
        not word or word in runtime.capabilities,
        f"Acceleration {acceleration.name!r} needs the capability {word!r}, but runtime "
        f"{runtime.name!r} {where}offers {_listed(runtime.capabilities)}; installed ones that "
        f"fit: {_listed(able)}.",
    )
