"""What a module is started with; everything unfit is refused here.

Nothing is spawned, and nothing heavy imported: names, plans, options, paths and cameras are checked
beforehand.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from roboneuron.config import Config, ControlConfig, InferenceConfig, PerceptionConfig, RobotConfig
from roboneuron.errors import (
    CheckpointError,
    InternalError,
    InvalidInputError,
    MissingDependencyError,
)
from roboneuron.modules.settings import ModuleKind, instruction_problem
from roboneuron.planning import Plan, check_plan
from roboneuron.plugins.loading import load_options, load_options_model
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import BackendSpec, DriverSpec, Spec
from roboneuron.server.module_kinds import KIND_ENTRIES, ModuleSection, StartInference
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


def select(kind: ModuleKind, config: Config, registry: Registry) -> Selection:
    """Check what is configured.

    Raises:
        InvalidInputError: something needed is not named, or the robot has no such camera.
        CheckpointError: the checkpoint's path does not exist, or the backend takes none.
        ConfigurationError: unknown or unusable names or options.
        PlanningError: the parts do not fit together or the robot.
    """
    section = configured_section(kind, config, registry)
    plan, spec, names = plan_of(kind, section, config, registry)
    name = next(iter(names.values()))
    options = dict(config.options(name))
    if isinstance(section, InferenceConfig):
        if section.instruction:
            check_instruction(section.instruction)
        section = _check_checkpoint(section, plan, config)
        if section.checkpoint is not None:
            options["checkpoint"] = names["checkpoint"] = section.checkpoint
    config = config.model_copy(update={kind: section})
    _check_options(spec, options, section.python, f"plugins.{name}")
    for part in (plan.runtime, plan.acceleration):
        if part is not None:
            _check_options(part, config.options(part.name), section.python)
    return Selection(kind=kind, config=config, names=names, plan=plan, python=section.python)


Choose = Callable[[ModuleKind, Config, Registry, Arguments | None, str], Selection]
"""Selects what a client asks for; called with kind, configuration, plugins, request and role;
raises as `select`.
"""


def choose_configured(
    kind: ModuleKind, config: Config, registry: Registry, request: Arguments | None, role: str
) -> Selection:
    """What is configured, with the instruction that a request names; whatever the role."""
    if not isinstance(request, KIND_ENTRIES[kind].request | None):
        raise InternalError(
            f"This server cannot read the {type(request).__name__} that a client sent for {kind}."
        )
    if isinstance(request, StartInference) and request.instruction is not None:
        section = configured_section(kind, config, registry)
        update = {"instruction": check_instruction(request.instruction)}
        config = config.model_copy(update={kind: section.model_copy(update=update)})
    return select(kind, config, registry)


def configured_section(kind: ModuleKind, config: Config, registry: Registry) -> ModuleSection:
    """The section of a kind. Raises InvalidInputError when there is none."""
    section: ModuleSection | None = getattr(config, kind)
    if section is None:
        entry = KIND_ENTRIES[kind]
        choices = ", ".join(registry.specs(entry.offer))
        raise InvalidInputError(
            f"The configuration names no {entry.noun}.",
            hint=f"Name one: {choices}." if choices else f"No {entry.offer} plugin is installed.",
            path=entry.noun,
        )
    return section


def plan_of(
    kind: ModuleKind, section: ModuleSection, config: Config, registry: Registry
) -> tuple[Plan, Spec | DriverSpec, dict[str, str]]:
    """The plan, what reads the options, and the names of what was chosen, the plugin first."""
    robot = section if isinstance(section, RobotConfig) else config.robot
    parts = (
        {"driver": robot}
        if section is robot
        else {"driver": robot, KIND_ENTRIES[kind].offer: section}
    )
    elsewhere = [name for name, part in parts.items() if part.python]
    check = partial(
        check_plan, registry, robot=robot.name, driver=robot.driver, elsewhere=elsewhere
    )
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
            return (
                plan,
                plan.perception,
                {"source": section.source, "cameras": ", ".join(section.cameras or known)},
            )
        case ControlConfig():
            plan = check(controller=section.controller)
            assert plan.controller is not None
            return plan, plan.controller, {"controller": section.controller}
        case InferenceConfig():
            plan = check(
                **section.model_dump(include={"backend", "runtime", "acceleration", "cameras"})
            )
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
        InvalidInputError: nothing is left, or it is too long or holds a control character.
    """
    if problem := instruction_problem(text):
        raise InvalidInputError(
            f"{problem}.", hint="Write plain text on one line.", path="instruction"
        )
    if not text.strip():
        raise InvalidInputError(
            "The instruction is empty.",
            hint='Say what to do, for instance "pick up the red cube".',
            path="instruction",
        )
    return text.strip()


def takes_checkpoint(backend: BackendSpec) -> bool:
    """Whether a backend needs a checkpoint, or has an option for one; raises as
    `load_options_model`.
    """
    if backend.needs_checkpoint:
        return True
    model = load_options_model(backend)
    return model is not None and "checkpoint" in model.model_fields


def _check_checkpoint(section: InferenceConfig, plan: Plan, config: Config) -> InferenceConfig:
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
    if not takes_checkpoint(plan.backend):
        raise CheckpointError(
            f"Backend {section.backend!r} takes no checkpoint, but {named!r} was named."
        )
    path = Path(str(named)).expanduser()
    if not path.exists():
        raise CheckpointError(
            f"The checkpoint {str(named)!r} does not exist.",
            hint=f"Looked for {path.absolute()} on the server's host.",
        )
    return section.model_copy(update={"checkpoint": str(path.absolute())})


def _check_options(
    spec: Spec | DriverSpec, options: Options, python: str | None, section: str | None = None
) -> None:
    """Validate options here when the plugin can be imported here; a module with its own environment
    does it itself.
    """
    try:
        load_options(spec, options, section=section)
    except MissingDependencyError:
        if python is None:
            raise
