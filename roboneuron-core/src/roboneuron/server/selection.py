"""What a module of each kind is started with; everything unfit is refused here.

Nothing is spawned, and nothing heavy imported: names, plans, options, paths and cameras are checked
beforehand.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field

from roboneuron.config import (
    Config,
    ControlConfig,
    InferenceConfig,
    ModuleSettings,
    PerceptionConfig,
    RobotConfig,
)
from roboneuron.errors import (
    CheckpointError,
    ConfigurationError,
    InternalError,
    InvalidInputError,
    MissingDependencyError,
    PluginError,
    RoboNeuronError,
)
from roboneuron.modules.plugin import check_module, module_class
from roboneuron.modules.settings import MAX_INSTRUCTION_LENGTH, ModuleKind, instruction_problem
from roboneuron.planning import Plan, check_plan
from roboneuron.plugins.loading import load_options
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, Spec
from roboneuron.server.tool import Arguments, NoArguments
from roboneuron.supervisor.slot import Selection

ModuleSection = RobotConfig | PerceptionConfig | ControlConfig | InferenceConfig


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


Instruction = Annotated[
    str, Field(max_length=MAX_INSTRUCTION_LENGTH), AfterValidator(check_instruction)
]
"""An argument `instruction` of a tool, as `check_instruction` returns it."""


class StartInference(Arguments):
    """Arguments of start_inference."""

    instruction: Instruction | None = Field(
        default=None,
        description='What to do at once, such as "pick up the red cube"; set_instruction gives '
        "one later.",
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class KindEntry:
    """One kind of module. Its section of roboneuron.toml is called as the kind is.

    Attributes:
        kind: which one; its node class is in `roboneuron.modules.plugin.module_class`.
        noun: what such a module runs.
        offer: kind of the plugins that offer it.
        section: model of its section.
        request: arguments of its start tool.
        stop_text: effect of its stop tool.
    """

    kind: ModuleKind
    noun: str
    offer: str
    section: type[ModuleSection]
    request: type[Arguments]
    stop_text: str

    def configured(self, config: Config, registry: Registry) -> ModuleSection:
        """The section of this kind. Raises InvalidInputError when there is none."""
        section: ModuleSection | None = getattr(config, self.kind)
        if section is None:
            choices = ", ".join(registry.specs(registry.kinds[self.offer]))
            raise InvalidInputError(
                f"The configuration names no {self.noun}.",
                hint=f"Name one: {choices}."
                if choices
                else f"No {self.offer} plugin is installed.",
                path=self.noun,
            )
        return section

    def plan(
        self, config: Config, registry: Registry
    ) -> tuple[Plan, Spec | DriverSpec, dict[str, str]]:
        """The plan, what reads the options, and the names of what was chosen, the plugin first.
        Raises as `configured`.
        """
        section, robot = self.configured(config, registry), config.robot
        parts = {"driver": robot} if section is robot else {"driver": robot, self.offer: section}
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
                    "cameras": ", ".join(
                        f"{role}={camera}" for role, camera in plan.cameras.items()
                    ),
                }
                return plan, plan.backend, {key: name for key, name in names.items() if name}

    def select(self, config: Config, registry: Registry) -> Selection:
        """What is configured, checked.

        Raises:
            InvalidInputError: something needed is not named, or the robot has no such camera.
            CheckpointError: the checkpoint's path does not exist, or the backend takes none.
            ConfigurationError: unknown or unusable names or options.
            PlanningError: the parts do not fit together or the robot.
        """
        section = self.configured(config, registry)
        plan, spec, names = self.plan(config, registry)
        module_class(self.kind, registry)
        name = next(iter(names.values()))
        options = dict(config.options(name))
        if isinstance(section, InferenceConfig):
            if section.instruction:
                check_instruction(section.instruction)
            section = _check_checkpoint(section, plan, config)
            if section.checkpoint is not None:
                options["checkpoint"] = names["checkpoint"] = section.checkpoint
        config = config.model_copy(update={self.kind: section})
        is_here = section.python is None and config.robot.python is None
        if is_here:  # the module does it again, where its own packages are
            check_module(self.kind, registry, plan, options, config.control)
        _check_options(spec, options, section.python, f"plugins.{name}")
        for part in (plan.runtime, plan.acceleration):
            if part is not None:
                _check_options(part, config.options(part.name), section.python)
        settings = ModuleSettings(kind=self.kind, node_name=self.kind, config=config)
        return Selection(settings=settings, names=names, plan=plan)


_ENTRIES = (
    KindEntry(
        kind="robot",
        noun="robot",
        offer="robot",
        section=RobotConfig,
        request=NoArguments,
        stop_text="Let the robot hold its position, and disconnect from it or end its simulation.",
    ),
    KindEntry(
        kind="perception",
        noun="source",
        offer="perception",
        section=PerceptionConfig,
        request=NoArguments,
        stop_text="Close the cameras; a policy without images sends no more actions.",
    ),
    KindEntry(
        kind="control",
        noun="controller",
        offer="controller",
        section=ControlConfig,
        request=NoArguments,
        stop_text="Stop the controller; the arm holds its position.",
    ),
    KindEntry(
        kind="inference",
        noun="backend",
        offer="backend",
        section=InferenceConfig,
        request=StartInference,
        stop_text="Stop the policy; the arm holds its position.",
    ),
)
KIND_ENTRIES: Mapping[ModuleKind, KindEntry] = {entry.kind: entry for entry in _ENTRIES}
"""The kinds in the order in which an agent starts them."""


Choose = Callable[[ModuleKind, Config, Registry, Arguments | None, str], Selection]
"""Selects what a client asks for; called with kind, configuration, plugins, request and role;
raises as `KindEntry.select`.
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
        section = KIND_ENTRIES[kind].configured(config, registry)
        update = {"instruction": request.instruction}
        config = config.model_copy(update={kind: section.model_copy(update=update)})
    return KIND_ENTRIES[kind].select(config, registry)


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
    if not plan.takes_checkpoint:
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
    spec: Spec | DriverSpec,
    options: Mapping[str, Any],
    python: str | None,
    section: str | None = None,
) -> None:
    """Validate options here when the plugin can be imported here; a module with its own environment
    does it itself.
    """
    absent = () if python is None else (MissingDependencyError,)
    with suppress(*absent):
        load_options(spec, options, section=section)


def check_configuration(config: Config, registry: Registry) -> None:
    """Refuse a configuration that names what is not installed or sets what is unknown, before the
    server starts.

    Raises:
        ConfigurationError, PlanningError: as `KindEntry.select`; all that is wrong.
    """
    configured = [
        entry for entry in KIND_ENTRIES.values() if getattr(config, entry.kind) is not None
    ]
    checks: list[Callable[[], None]] = [
        partial(_check_kind, entry, config, registry) for entry in configured
    ]
    checks += [
        partial(_check_section, name, options, registry) for name, options in config.plugins.items()
    ]
    problems: dict[str, RoboNeuronError] = {}
    for check in checks:
        try:
            check()
        except RoboNeuronError as error:
            problems.setdefault(str(error), error)
    if len(problems) == 1:
        raise next(iter(problems.values()))
    if problems:
        raise ConfigurationError("\n".join(problems))


def _check_kind(entry: KindEntry, config: Config, registry: Registry) -> None:
    try:
        entry.select(config, registry)
    except InvalidInputError as error:  # a checkpoint may be named later, by the agent
        if error.path != "checkpoint":
            raise ConfigurationError(error.message, hint=error.hint) from error


def _check_section(name: str, options: Mapping[str, object], registry: Registry) -> None:
    """Refuse `[plugins.<name>]` of what does not exist, with unknown options, or with values that
    no plugin of that name takes.

    Options that are missing are no error: an agent may give them, or never choose that plugin.
    """
    registry.check_name(f"[plugins.{name}]", name)
    refused: list[ConfigurationError] = []
    for spec in registry.readers_of(name):
        try:
            load_options(spec, options, section=f"plugins.{name}", is_partial=True)
        except ConfigurationError as error:
            refused.append(error)
        except (MissingDependencyError, PluginError):
            return  # not to be judged here; told where it is chosen
        else:
            return
    if refused:
        raise refused[0]
