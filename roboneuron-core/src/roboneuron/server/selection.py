"""From a tool's arguments to the configuration a module is started with; everything unfit is refused here.

Nothing is spawned, and nothing heavy imported: names, plans, options, paths and cameras are checked beforehand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roboneuron.config import Config, ControlConfig, InferenceConfig, PerceptionConfig, RobotConfig
from roboneuron.errors import CheckpointError, InvalidInputError, MissingDependencyError
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import Plan, check_plan
from roboneuron.plugins.loading import load_options, load_options_model
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, Spec
from roboneuron.server.option_rights import check_may_load, check_may_set
from roboneuron.server.requests import StartControl, StartInference, StartPerception, StartRobot

Options = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True, slots=True)
class Selection:
    """What to start.

    Attributes:
        kind: of the module.
        config: the effective configuration.
        names: what was chosen, for messages and the status.
        plan: the descriptors behind these names.
        python: interpreter of the module's own environment.
    """

    kind: ModuleKind
    config: Config
    names: Mapping[str, str]
    plan: Plan
    python: str | None


def select_robot(config: Config, registry: Registry, request: StartRobot, role: str = "") -> Selection:
    """Check a robot and its driver.

    Args:
        role: of the client that made the request; here and below, "" may set nothing that is restricted.

    Raises:
        ConfigurationError: unknown or unusable names or options.
        RefusedError: options that only the configuration may set.
    """
    section = config.robot
    if request.robot is not None and request.robot != section.name:
        section = RobotConfig(name=request.robot)
    if request.driver is not None:
        section = section.model_copy(update={"driver": request.driver})
    plan = check_plan(registry, robot=section.name, driver=section.driver)
    config = _merge(config, section.name, plan.driver, request.options, role).model_copy(update={"robot": section})
    _check_options(plan.driver, config.options(section.name), section.python, f"plugins.{section.name}")
    names = {"robot": section.name, "driver": section.driver}
    return Selection(kind="robot", config=config, names=names, plan=plan, python=section.python)


def select_perception(config: Config, registry: Registry, request: StartPerception, role: str = "") -> Selection:
    """Check a source and its cameras.

    Raises:
        InvalidInputError: no source is configured, or the robot has no such camera.
        ConfigurationError: unknown or unusable names or options.
        RefusedError: options that only the configuration may set.
        PlanningError: the source does not serve this robot.
    """
    section = config.perception
    if section is None or (request.source is not None and request.source != section.source):
        if request.source is None:
            raise _unnamed("source", "perception", registry)
        section = PerceptionConfig(source=request.source)
    if request.cameras:
        section = section.model_copy(update={"cameras": tuple(request.cameras)})
    plan = _plan(config, registry, perception=section.source)
    known = [camera.name for camera in plan.robot.cameras]
    for camera in section.cameras:
        if camera not in known:
            raise InvalidInputError(
                f"Robot {plan.robot.name!r} has no camera {camera!r}.",
                hint=f"Its cameras: {', '.join(known) or 'none'}.",
            )
    assert plan.perception is not None
    config = _merge(config, section.source, plan.perception, request.options, role)
    config = config.model_copy(update={"perception": section})
    _check_options(plan.perception, config.options(section.source), section.python)
    names = {"source": section.source, "cameras": ", ".join(section.cameras or known)}
    return Selection(kind="perception", config=config, names=names, plan=plan, python=section.python)


def select_control(config: Config, registry: Registry, request: StartControl, role: str = "") -> Selection:
    """Check a controller.

    Raises:
        InvalidInputError: none is configured and none was named.
        ConfigurationError: unknown or unusable names or options.
        RefusedError: options that only the configuration may set.
        PlanningError: it cannot move this kind of robot.
    """
    section = config.control
    if section is None or (request.controller is not None and request.controller != section.controller):
        if request.controller is None:
            raise _unnamed("controller", "controller", registry)
        section = ControlConfig(controller=request.controller)
    plan = _plan(config, registry, controller=section.controller)
    assert plan.controller is not None
    config = _merge(config, section.controller, plan.controller, request.options, role)
    config = config.model_copy(update={"control": section})
    _check_options(plan.controller, config.options(section.controller), section.python)
    names = {"controller": section.controller}
    return Selection(kind="control", config=config, names=names, plan=plan, python=section.python)


def select_inference(config: Config, registry: Registry, request: StartInference, role: str = "") -> Selection:
    """Check a backend with all that belongs to it.

    Raises:
        InvalidInputError: something needed is not named, or the instruction is blank.
        CheckpointError: the checkpoint's path does not exist, or the backend takes none.
        ConfigurationError: unknown or unusable names or options.
        PlanningError: the parts do not fit together or the robot.
        RefusedError: options that only the configuration may set, or a checkpoint outside of what it allows.
    """
    section = config.inference
    if section is None or (request.backend is not None and request.backend != section.backend):
        if request.backend is None:
            raise _unnamed("backend", "backend", registry)
        section = InferenceConfig(backend=request.backend)
    named = {
        "checkpoint": request.checkpoint,
        "runtime": request.runtime,
        "acceleration": request.acceleration,
        "instruction": None if request.instruction is None else check_instruction(request.instruction),
        "cameras": None if request.cameras is None else dict(request.cameras),
    }
    section = section.model_copy(update={key: value for key, value in named.items() if value is not None})
    plan = _plan(
        config,
        registry,
        backend=section.backend,
        runtime=section.runtime,
        acceleration=section.acceleration,
        cameras=section.cameras,
    )
    assert plan.backend is not None
    config = _merge(config, section.backend, plan.backend, request.options, role)
    section = _check_checkpoint(section, plan, config, request.checkpoint)
    config = config.model_copy(update={"inference": section})
    options = dict(config.options(section.backend))
    if section.checkpoint is not None:
        options["checkpoint"] = section.checkpoint
    _check_options(plan.backend, options, section.python)
    for spec in (plan.runtime, plan.acceleration):
        if spec is not None:
            _check_options(spec, config.options(spec.name), section.python)
    names = {
        "backend": section.backend,
        "checkpoint": section.checkpoint or "",
        "runtime": plan.runtime.name if plan.runtime else "",
        "acceleration": plan.acceleration.name if plan.acceleration else "",
        "cameras": ", ".join(f"{role}={camera}" for role, camera in plan.cameras.items()),
    }
    chosen = {key: name for key, name in names.items() if name}
    return Selection(kind="inference", config=config, names=chosen, plan=plan, python=section.python)


def check_instruction(text: str) -> str:
    """Return the instruction without blanks around it.

    Raises:
        InvalidInputError: nothing is left.
    """
    if not text.strip():
        raise InvalidInputError(
            "The instruction is empty.", hint='Say what to do, for instance "pick up the red cube".', path="instruction"
        )
    return text.strip()


def _check_checkpoint(section: InferenceConfig, plan: Plan, config: Config, requested: str | None) -> InferenceConfig:
    """The section with an absolute path: the module may run in another working directory."""
    assert plan.backend is not None
    named = section.checkpoint or config.options(section.backend).get("checkpoint")
    if named is None:
        if plan.backend.needs_checkpoint:
            raise InvalidInputError(
                f"Backend {section.backend!r} needs a checkpoint.",
                hint="Name the directory of the model's files in `checkpoint`.",
                path="checkpoint",
            )
        return section
    model = load_options_model(plan.backend) if not plan.backend.needs_checkpoint else None
    if not plan.backend.needs_checkpoint and (model is None or "checkpoint" not in model.model_fields):
        raise CheckpointError(f"Backend {section.backend!r} takes no checkpoint, but {named!r} was named.")
    if requested is not None:
        check_may_load(config, requested)
    path = Path(str(named)).expanduser()
    if not path.exists():
        raise CheckpointError(
            f"The checkpoint {str(named)!r} does not exist.", hint=f"Looked for {path.absolute()} on the server's host."
        )
    return section.model_copy(update={"checkpoint": str(path.absolute())})


def _plan(config: Config, registry: Registry, **parts: Any) -> Plan:
    return check_plan(registry, robot=config.robot.name, driver=config.robot.driver, **parts)


def _merge(config: Config, name: str, spec: Spec | DriverSpec, options: Options, role: str) -> Config:
    """The configuration with a client's `options` laid over `[plugins.<name>]`, where the client may set them."""
    if not options:
        return config
    before = config.options(name)
    merged = {**before, **options}
    check_may_set(spec, name, before, merged, config.server.agent_options, role)
    return config.model_copy(update={"plugins": {**config.plugins, name: merged}})


def _check_options(spec: Spec | DriverSpec, options: Options, python: str | None, section: str | None = None) -> None:
    """Validate options here when the plugin can be imported here; a module with its own environment does it itself."""
    try:
        load_options(spec, options, section=section)
    except MissingDependencyError:
        if python is None:
            raise


def _unnamed(argument: str, kind: str, registry: Registry) -> InvalidInputError:
    choices = ", ".join(registry.specs(kind))
    return InvalidInputError(
        f"The configuration names no {argument}.",
        hint=f"Name one: {choices}." if choices else f"No {kind} plugin is installed.",
        path=argument,
    )
