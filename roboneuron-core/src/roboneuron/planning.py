"""Compatibility check of configured modules from descriptors alone, before anything is started or
anything heavy imported.

Core plans the robot module; the features that provide the other modules plan those.
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
    """A checked module, resolved to descriptors, from which it is started. Features derive their
    own plans.

    Attributes:
        kind: kind of the module.
        config: configuration for its process.
        robot, driver: descriptors of the robot and its driver.
        spec: descriptor of the module's content, which reads the options.
        names: chosen names, for messages and the status: {"controller": "ik", ...}; the first is
            the plugin whose options are read.
        inputs: kinds of modules that provide its inputs.
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
        """Options of that plugin."""
        return self.config.options(self.plugin)

    @property
    def others(self) -> tuple[Spec, ...]:
        """Descriptors of the other plugins it uses, each with its own options."""
        return ()

    def checked(self, registry: Registry) -> Plan:
        """Return the plan for the start, with absolute paths; called before each start. Raises
        RoboNeuronError for errors that names alone do not show, such as a missing file.
        """
        return self

    def check_beside(self, running: Mapping[ModuleKind, Config]) -> None:
        """Raise RoboNeuronError if it is incompatible with the running modules.

        Args:
            running: configuration of each running module, this one included.
        """


@dataclass(frozen=True, kw_only=True, slots=True)
class KindEntry:
    """One kind of module. Its section of roboneuron.toml has the same name.

    Attributes:
        kind: the kind; `roboneuron.modules.module` chooses what its process runs.
        noun: word for the content of such a module.
        offer: kind of the plugins for it.
        section: model of its section.
        title, start_text: title and effect of its start tool.
        proof: evidence of a successful start.
        stop_text: effect of its stop tool.
        inputs: kinds of modules that provide its inputs, where no `module_plan` says so.
    """

    kind: ModuleKind
    noun: str
    offer: str
    section: type[ModuleSection]
    title: str
    start_text: str
    proof: str
    stop_text: str
    inputs: tuple[ModuleKind, ...] = ()

    def configured(self, config: Config, registry: Registry) -> ModuleSection:
        """Return the section of this kind. Raises InvalidInputError if it is missing."""
        section = config.module_section(self.kind)
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
        """Plan the configured module and check that its parts are compatible.

        Raises:
            InvalidInputError: a required name is missing.
            ConfigurationError: a name is not installed or unusable, or no feature provides such
                modules.
            PlanningError: the parts are incompatible; the message says which two and what would
                fit.
        """
        self.configured(config, registry)
        own = None if self.kind == "robot" else registry.get(FeatureSpec, self.kind)
        if own is not None and own.module_plan is not None:
            named = load_attribute(own.module_plan, f"`module_plan` of {own.name!r}")
            return cast("Callable[[Config, Registry], Plan]", named)(config, registry)
        section = config.robot
        is_elsewhere = section.python is not None
        robot, driver = find_robot(
            registry, section.name, section.driver, is_elsewhere=is_elsewhere
        )
        return Plan(
            kind=self.kind,
            config=config,
            robot=robot,
            driver=driver,
            spec=own or driver,
            names={self.noun: own.name}
            if own is not None
            else {"robot": robot.name, "driver": driver.name},
            inputs=self.inputs,
        )

    def check(self, config: Config, registry: Registry) -> Plan:
        """Plan the configured module and check that it can be started.

        Raises:
            RoboNeuronError: as `plan` and `Plan.checked`.
            ConfigurationError: unknown or unusable options.
        """
        plan = self.plan(config, registry).checked(registry)
        python = self.configured(plan.config, registry).python
        if not isinstance(plan.spec, FeatureSpec):  # whose section was checked when it was read
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
        title="Start the robot",
        start_text="Connect to the robot, or start its simulation. It stands still until something "
        "moves it.",
        proof="its joints are measured",
        stop_text="Let the robot hold its position, and disconnect from it or end its simulation.",
    ),
    KindEntry(
        kind="perception",
        noun="source",
        offer="perception",
        section=PerceptionConfig,
        title="Start the cameras",
        start_text="Start the cameras. A simulated robot's cameras need start_robot first.",
        proof="each camera has delivered an image",
        stop_text="Close the cameras; a policy without images sends no more actions.",
    ),
    KindEntry(
        kind="control",
        noun="controller",
        offer="controller",
        section=ControlConfig,
        title="Start the controller",
        start_text="Start the controller, which turns the policy's actions, and move_ee, into "
        "joint commands. Needs start_robot. The arm stands still until actions come.",
        proof="it measures the pose of the end effector",
        stop_text="Stop the controller; the arm holds its position.",
    ),
    KindEntry(
        kind="inference",
        noun="backend",
        offer="backend",
        section=InferenceConfig,
        title="Start the policy",
        start_text="Load a policy (a vision-language-action model or a classical one). With an "
        "instruction the robot moves at once. Needs start_perception; to move, also start_robot "
        "and start_control.",
        proof="it receives its inputs and, with an instruction, has sent its first action",
        stop_text="Stop the policy; the arm holds its position.",
    ),
)
KIND_ENTRIES: Mapping[ModuleKind, KindEntry] = {entry.kind: entry for entry in _ENTRIES}
"""Core's kinds in the order in which an agent starts them."""


def added_kind(spec: FeatureSpec) -> KindEntry | None:
    """The entry of the kind of modules that a feature adds; None if it adds none."""
    added = spec.module_kind
    if added is None:
        return None
    return KindEntry(
        kind=spec.name,
        noun=spec.name,
        offer="feature",
        section=ModuleSection,
        title=added.title,
        start_text=added.start_text,
        proof=added.proof,
        stop_text=added.stop_text,
        inputs=added.inputs,
    )


def find_robot(
    registry: Registry, name: str, driver: str, *, is_elsewhere: bool = False
) -> tuple[RobotSpec, DriverSpec]:
    """Return a robot and its driver.

    Args:
        registry: the installed plugins.
        name, driver: names of the robot and of its driver.
        is_elsewhere: the driver runs under another interpreter: modules that it needs may be absent
            here.

    Raises:
        ConfigurationError: the robot is not installed or unusable.
        PlanningError: it has no such driver, or the driver is unusable.
    """
    robot = registry.get(RobotSpec, name)
    found = robot.driver(driver)
    if found is None:
        raise PlanningError(
            f"Robot {name!r} has no driver {driver!r}; choose one of: "
            f"{', '.join(known.name for known in robot.drivers) or 'none'}."
        )
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
    """Validate options if the plugin can be imported here; a module with its own environment
    validates its options itself.
    """
    absent = () if python is None else (MissingDependencyError,)
    with suppress(*absent):
        load_options(spec, options, section=section)


def check_configuration(config: Config, registry: Registry) -> None:
    """Refuse a configuration that names uninstalled plugins or sets unknown options, before the
    server starts.

    Raises:
        ConfigurationError, PlanningError: as `KindEntry.check`; lists all errors.
    """
    checks: list[Callable[[], None]] = [
        partial(_check_kind, kind, config, registry) for kind in config.module_kinds
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
    entry = KIND_ENTRIES.get(kind) or added_kind(registry.get(FeatureSpec, kind))
    assert entry is not None
    try:
        entry.check(config, registry)
    except InvalidInputError as error:  # a checkpoint may be named later, by the agent
        if error.path != "checkpoint":
            raise ConfigurationError(error.message, hint=error.hint) from error


def _check_section(name: str, options: Mapping[str, object], registry: Registry) -> None:
    """Refuse `[plugins.<name>]` for an unknown plugin, with unknown options, or with values that no
    plugin of that name accepts.

    Missing options are no error: an agent may give them, or never choose that plugin.
    """
    registry.check_name(f"[plugins.{name}]", name)
    refused: list[ConfigurationError] = []
    for spec in registry.readers_of(name):
        try:
            load_options(spec, options, section=f"plugins.{name}", is_partial=True)
        except ConfigurationError as error:
            refused.append(error)
        except (MissingDependencyError, PluginError):
            return  # cannot be checked here; reported where it is chosen
        else:
            return
    if refused:
        raise refused[0]
