"""Does a configured module fit? Answered from descriptors alone, in one sentence, before anything
is started or anything heavy imported.

Core plans the module of the robot; the features that bring the others plan those.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import cast

from roboneuron.config import (
    Config,
    ControlConfig,
    InferenceConfig,
    PerceptionConfig,
    RobotConfig,
)
from roboneuron.config.models import ModuleKind, ModuleSection
from roboneuron.errors import (
    ConfigurationError,
    InvalidInputError,
    MissingDependencyError,
    PlanningError,
    PluginError,
    RoboNeuronError,
)
from roboneuron.plugins.availability import explain, missing
from roboneuron.plugins.loading import load_attribute, load_options
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import DriverSpec, FeatureSpec, RobotSpec, Spec


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """A module that fits, resolved to descriptors: what it is started with, or was. Features derive
    their own.

    Attributes:
        kind: of the module.
        config: what its process is told.
        robot, driver: what moves.
        spec: of what the module runs, which reads the options.
        names: what was chosen, for messages and the status: {"controller": "ik", ...}; the first is
            the plugin whose options are read.
        inputs: kinds of modules that it takes inputs from.
    """

    kind: ModuleKind
    config: Config
    robot: RobotSpec
    driver: DriverSpec
    spec: Spec | DriverSpec
    names: Mapping[str, str]
    inputs: tuple[ModuleKind, ...] = ()

    @property
    def plugin(self) -> str:
        """Name of the plugin whose options are read."""
        return next(iter(self.names.values()))

    @property
    def options(self) -> Mapping[str, object]:
        """Of that plugin."""
        return self.config.options(self.plugin)

    @property
    def others(self) -> tuple[Spec, ...]:
        """Descriptors of what it uses beside that plugin, each with options of its own."""
        return ()

    def checked(self, registry: Registry) -> Plan:
        """The plan as it is started, with paths that are absolute. Raises RoboNeuronError for what
        names alone do not tell, such as a missing file; called before each start.
        """
        return self

    def check_beside(self, running: Mapping[ModuleKind, Config]) -> None:
        """Raise RoboNeuronError when it does not go together with the modules that run.

        Args:
            running: what each was started with; this one is among them.
        """


@dataclass(frozen=True, kw_only=True, slots=True)
class KindEntry:
    """One kind of module. Its section of roboneuron.toml is called as the kind is.

    Attributes:
        kind: which one; what its process runs is chosen in `roboneuron.modules.module`.
        noun: what such a module runs.
        offer: kind of the plugins that offer it.
        section: model of its section.
        stop_text: effect of its stop tool.
    """

    kind: ModuleKind
    noun: str
    offer: str
    section: type[ModuleSection]
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

    def plan(self, config: Config, registry: Registry) -> Plan:
        """What is configured, found and compared.

        Raises:
            InvalidInputError: something needed is not named.
            ConfigurationError: a name is not installed or cannot be used, or no feature brings such
                modules.
            PlanningError: the parts do not fit; the message says which two and what would.
        """
        self.configured(config, registry)
        if self.kind == "robot":
            section = config.robot
            is_elsewhere = section.python is not None
            robot, driver = find_robot(
                registry, section.name, section.driver, is_elsewhere=is_elsewhere
            )
            names = {"robot": robot.name, "driver": driver.name}
            return Plan(
                kind=self.kind, config=config, robot=robot, driver=driver, spec=driver, names=names
            )
        spec = registry.get(FeatureSpec, self.kind)  # it is called as the kind
        named = load_attribute(spec.module_plan or "", f"`module_plan` of {spec.name!r}")
        return cast("Callable[[Config, Registry], Plan]", named)(config, registry)

    def check(self, config: Config, registry: Registry) -> Plan:
        """What is configured, as it can be started.

        Raises:
            RoboNeuronError: as `plan` and `Plan.checked`.
            ConfigurationError: unknown or unusable options.
        """
        plan = self.plan(config, registry).checked(registry)
        python = getattr(plan.config, self.kind).python
        _check_options(plan.spec, plan.options, python, f"plugins.{plan.plugin}")
        for part in plan.others:
            _check_options(part, plan.config.options(part.name), python)
        return plan


_ENTRIES = (
    KindEntry(
        kind="robot",
        noun="robot",
        offer="robot",
        section=RobotConfig,
        stop_text="Let the robot hold its position, and disconnect from it or end its simulation.",
    ),
    KindEntry(
        kind="perception",
        noun="source",
        offer="perception",
        section=PerceptionConfig,
        stop_text="Close the cameras; a policy without images sends no more actions.",
    ),
    KindEntry(
        kind="control",
        noun="controller",
        offer="controller",
        section=ControlConfig,
        stop_text="Stop the controller; the arm holds its position.",
    ),
    KindEntry(
        kind="inference",
        noun="backend",
        offer="backend",
        section=InferenceConfig,
        stop_text="Stop the policy; the arm holds its position.",
    ),
)
KIND_ENTRIES: Mapping[ModuleKind, KindEntry] = {entry.kind: entry for entry in _ENTRIES}
"""The kinds in the order in which an agent starts them."""


def find_robot(
    registry: Registry, name: str, driver: str, *, is_elsewhere: bool = False
) -> tuple[RobotSpec, DriverSpec]:
    """A robot and its driver.

    Args:
        registry: what is installed.
        name, driver: of the robot, and of what moves it.
        is_elsewhere: the driver runs under another interpreter: modules that it needs may be absent
            here.

    Raises:
        ConfigurationError: the robot is not installed or cannot be used.
        PlanningError: it has no such driver, or that cannot be used.
    """
    robot = registry.get(RobotSpec, name)
    found = robot.driver(driver)
    if found is None:
        names = ", ".join(d.name for d in robot.drivers) or "none"
        raise PlanningError(f"Robot {name!r} has no driver {driver!r}; choose one of: {names}.")
    absent = missing(found.requires)
    if absent and not is_elsewhere:
        raise PlanningError(
            f"Driver {driver!r} of robot {name!r} cannot be used: {explain(absent)}"
        )
    return robot, found


def _check_options(
    spec: Spec | DriverSpec,
    options: Mapping[str, object],
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
        ConfigurationError, PlanningError: as `KindEntry.check`; all that is wrong.
    """
    checks: list[Callable[[], None]] = [
        partial(_check_kind, kind, config, registry)
        for kind in KIND_ENTRIES
        if getattr(config, kind) is not None
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


def _check_kind(kind: ModuleKind, config: Config, registry: Registry) -> None:
    try:
        KIND_ENTRIES[kind].check(config, registry)
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
