"""From a tool's arguments to the configuration a module is started with; everything unfit is refused here.

Nothing is spawned, and nothing heavy imported: names, plans, options, paths and cameras are checked beforehand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from roboneuron.config import Config, ControlConfig, InferenceConfig, PerceptionConfig, RobotConfig
from roboneuron.errors import CheckpointError, InvalidInputError, MissingDependencyError
from roboneuron.modules.settings import ModuleKind
from roboneuron.planning import Plan, check_plan
from roboneuron.plugins.loading import load_options, load_options_model
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, Spec
from roboneuron.server.access import check_may_load, check_may_set
from roboneuron.server.module_kinds import KINDS, Section
from roboneuron.server.tool import Arguments

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


def select(
    kind: ModuleKind, config: Config, registry: Registry, request: Arguments | None = None, role: str = ""
) -> Selection:
    """Check what a client asks for, or without a request what is configured.

    Args:
        kind: of the module.
        config, registry: the configuration, and the installed plugins.
        request: of the kind's model.
        role: of the client that made the request; "" may set nothing that is restricted.

    Raises:
        InvalidInputError: something needed is not named, the robot has no such camera, or the instruction is blank.
        CheckpointError: the checkpoint's path does not exist, or the backend takes none.
        ConfigurationError: unknown or unusable names or options.
        PlanningError: the parts do not fit together or the robot.
        RefusedError: options that only the configuration may set, or a checkpoint outside of what it allows.
    """
    request = request or KINDS[kind].request()
    model = getattr(request, "model", None)
    if model is not None:
        config, request = _with_model(config, request, model)
    section = _section(kind, config, registry, request)
    plan, spec, names = _plan(section, config, registry)
    name = next(iter(names.values()))
    config = _merge(config, name, spec, getattr(request, "options", {}), role)
    options = dict(config.options(name))
    if isinstance(section, InferenceConfig):
        section = _check_checkpoint(section, plan, config, getattr(request, "checkpoint", None))
        if section.checkpoint is not None:
            options["checkpoint"] = names["checkpoint"] = section.checkpoint
    if model is not None:
        names["model"] = model
    config = config.model_copy(update={kind: section})
    _check_options(spec, options, section.python, f"plugins.{name}")
    for part in (plan.runtime, plan.acceleration):
        if part is not None:
            _check_options(part, config.options(part.name), section.python)
    return Selection(kind=kind, config=config, names=names, plan=plan, python=section.python)


def _with_model(config: Config, request: Arguments, name: str) -> tuple[Config, Arguments]:
    """The configuration with `[models.<name>]` as what is configured for inference, and the rest of the request.

    Raises:
        InvalidInputError: there is no such model, or the request names a part of it too.
    """
    model = config.models.get(name)
    if model is None:
        listed = ", ".join(config.models) or "none; a person adds them as [models.<name>]"
        raise InvalidInputError(
            f"There is no model {name[:80]!r}.", hint=f"The configuration has: {listed}.", path="model"
        )
    for part in ("backend", "checkpoint", "runtime", "acceleration"):
        if getattr(request, part) is not None:
            raise InvalidInputError(f"The model {name!r} names its {part} itself; leave it out.", path=part)
    parts = {"checkpoint": model.checkpoint, "runtime": model.runtime, "acceleration": model.preset}
    section = config.inference
    if section is None or section.backend != model.backend:
        section = InferenceConfig(backend=model.backend)
    profile = {} if model.profile is None else {"profile": model.profile}
    options = {**config.options(model.backend), **profile, **model.options}
    plugins = {**config.plugins, model.backend: options}
    config = config.model_copy(update={"inference": section.model_copy(update=parts), "plugins": plugins})
    return config, request.model_copy(update={"model": None})


def _section(kind: ModuleKind, config: Config, registry: Registry, request: Arguments) -> Section:
    """The configured section with what the request names; one of its own for another plugin than the configured."""
    entry = KINDS[kind]
    field = "name" if kind == "robot" else entry.noun
    section: Section | None = getattr(config, kind)
    named = {key: getattr(request, key) for key in entry.request.model_fields if key not in ("options", "model")}
    wanted = named.pop(entry.noun)
    if section is None and wanted is None:
        choices = ", ".join(registry.specs(entry.choices[entry.noun]))
        raise InvalidInputError(
            f"The configuration names no {entry.noun}.",
            hint=f"Name one: {choices}." if choices else f"No {entry.choices[entry.noun]} plugin is installed.",
            path=entry.noun,
        )
    if section is None or wanted not in (None, getattr(section, field)):
        section = entry.section.model_validate({field: wanted})
    if named.get("instruction") is not None:
        named["instruction"] = check_instruction(named["instruction"])
    if kind == "perception":
        named["cameras"] = tuple(named["cameras"]) or None
    return section.model_copy(update={key: value for key, value in named.items() if value is not None})


_PARTS: Mapping[type[Section], str] = {
    RobotConfig: "driver",
    PerceptionConfig: "perception",
    ControlConfig: "controller",
    InferenceConfig: "backend",
}
"""What runs in a module, as `check_plan` names it."""


def _plan(section: Section, config: Config, registry: Registry) -> tuple[Plan, Spec | DriverSpec, dict[str, str]]:
    """The plan, what reads the options, and the names of what was chosen, the plugin first."""
    robot = section if isinstance(section, RobotConfig) else config.robot
    elsewhere = [_PARTS[type(part)] for part in (robot, section) if part.python]
    check = partial(check_plan, registry, robot=robot.name, driver=robot.driver, elsewhere=elsewhere)
    match section:
        case RobotConfig():
            plan = check()
            return plan, plan.driver, {"robot": section.name, "driver": section.driver}
        case PerceptionConfig():
            plan = check(perception=section.source)
            assert plan.perception is not None
            known = [camera.name for camera in plan.robot.cameras]
            for camera in section.cameras:
                if camera not in known:
                    raise InvalidInputError(
                        f"Robot {plan.robot.name!r} has no camera {camera!r}.",
                        hint=f"Its cameras: {', '.join(known) or 'none'}.",
                    )
            return plan, plan.perception, {"source": section.source, "cameras": ", ".join(section.cameras or known)}
        case ControlConfig():
            plan = check(controller=section.controller)
            assert plan.controller is not None
            return plan, plan.controller, {"controller": section.controller}
        case InferenceConfig():
            plan = check(**section.model_dump(include={"backend", "runtime", "acceleration", "cameras"}))
            assert plan.backend is not None
            names = {
                "backend": section.backend,
                "checkpoint": section.checkpoint or "",
                "runtime": plan.runtime.name if plan.runtime else "",
                "acceleration": plan.acceleration.name if plan.acceleration else "",
                "cameras": ", ".join(f"{role}={camera}" for role, camera in plan.cameras.items()),
            }
            return plan, plan.backend, {key: name for key, name in names.items() if name}


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
