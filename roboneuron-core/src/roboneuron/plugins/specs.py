"""Descriptors: what a plugin offers, said with the standard library alone, so that it is listed
without being loaded.

`target` and `config` are written "package.module:attribute". `target` is called with the arguments
that the protocol of its kind names (see `roboneuron.contract.protocols`); `config` is a pydantic
model class whose fields are the options a user may set under `[plugins.<name>]`, or None when there
are none.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

CONTRACT_VERSION = 1
"""Raised when a descriptor or protocol changes in a way that old plugins cannot follow."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Requirement:
    """An importable module a plugin needs beyond its own package.

    Attributes:
        module: top-level import name, looked up without importing it.
        install: the command that provides it, shown to the user.
        alternatives: modules of which each will do instead of `module`.
    """

    module: str
    install: str
    alternatives: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class ActionSpace:
    """The chunks that a model family produces; the backend converts them to the contract's
    7-vector, or to the `space` that it declares.

    Attributes:
        width: values per step and arm set; planning refuses what the robot's `action_widths` lacks.
        horizon: actions per inference.
        step_s: nominal time between two actions [s]; 0 when the checkpoint's profile says it.
    """

    width: int = 7
    horizon: int = 1
    step_s: float = 0.1


@dataclass(frozen=True, kw_only=True, slots=True)
class Loadable:
    """What has a name and can be loaded.

    Attributes:
        name: unique within its kind; lower-case letters, digits and hyphens.
        summary: one line for tables and for the agent's choices.
        target: "module:attribute" of the class.
        config: "module:attribute" of the pydantic options model, or None.
        requires: modules that must be importable before `target` is.
    """

    name: str
    summary: str
    target: str
    config: str | None = None
    requires: tuple[Requirement, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class Spec(Loadable):
    """What every descriptor has.

    Attributes:
        contract: the CONTRACT_VERSION the plugin was written for.
        case: "module:attribute" of a function without arguments that returns this descriptor's
            contract case: what `roboneuron plugins check` needs to try it (an observation it can
            act on, a small checkpoint); None when its options' defaults and synthetic input
            suffice. Never loaded otherwise.
    """

    kind: ClassVar[str] = ""

    contract: int = CONTRACT_VERSION
    case: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class BackendSpec(Spec):
    """A policy: image and instruction to actions.

    Attributes:
        cameras: roles it needs a frame of, in order.
        optional_cameras: roles it uses when the robot has them.
        needs_state: it reads joints, TCP pose and gripper of the observation.
        needs_checkpoint: `start_inference` must name a checkpoint directory (a pydantic field
            `checkpoint`).
        action_space: what the model produces itself.
        family: model family, matched with runtimes and accelerations; empty when it takes neither.
        runtimes_required: it cannot run without a runtime of its family.
        default_runtime: runtime used when the user names none; empty for none.
        capabilities: words accelerations may require of it.
        conditions_on_rows: it continues `Observation.ahead.rows` (real-time chunking), and says how
            many of them in `ActionChunk.conditioned_rows`.
        max_committed_rows: greatest prefix that it was trained to keep; 0 for any number.
        takes_predicted_state: it was trained on states ahead of the image and reads TCP pose and
            gripper only (joints cannot be predicted from TCP deltas); it may be given them rolled
            forward to the end of the running chunk.
        space: "module:attribute" of what says which space its chunks have: called with the options
            (a mapping, unchecked) and the robot's profile, before anything heavy is imported,
            returns a `ControlSpace` or raises a RoboNeuronError. It may read small files of the
            checkpoint; None where the loaded backend tells it (`served_spec`). None: `ee_delta`,
            always.
    """

    kind: ClassVar[str] = "backend"

    cameras: tuple[str, ...] = ("primary",)
    optional_cameras: tuple[str, ...] = ()
    needs_state: bool = False
    needs_checkpoint: bool = False
    action_space: ActionSpace = ActionSpace()
    family: str = ""
    runtimes_required: bool = False
    default_runtime: str = ""
    capabilities: tuple[str, ...] = ()
    conditions_on_rows: bool = False
    max_committed_rows: int = 0
    takes_predicted_state: bool = False
    space: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class RuntimeSpec(Spec):
    """Executes decoders for backends.

    Attributes:
        families: model families it can execute.
        capabilities: words accelerations may require of it ("visual-token-pruning").
        served: the model runs in another process or host.
    """

    kind: ClassVar[str] = "runtime"

    families: tuple[str, ...] = ()
    capabilities: tuple[str, ...] = ()
    served: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class AccelerationSpec(Spec):
    """A named preset applied to a loaded model.

    Attributes:
        families: model families it knows.
        capability: the word a runtime must offer.
    """

    kind: ClassVar[str] = "acceleration"

    families: tuple[str, ...] = ()
    capability: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class PerceptionSpec(Spec):
    """A source of camera frames.

    Attributes:
        robots: names of the robots it can serve; empty for any.
        drivers: robot drivers it needs ("simulated" for a simulator's cameras); empty for any.
    """

    kind: ClassVar[str] = "perception"

    robots: tuple[str, ...] = ()
    drivers: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class ControllerSpec(Spec):
    """Turns actions into joint commands.

    Attributes:
        robot_kinds: kinds of robot it can move ("arm", "base").
        spaces: kinds of control spaces that it executes; others than `ee_delta` by
            `SpaceController.execute`.
    """

    kind: ClassVar[str] = "controller"

    robot_kinds: tuple[str, ...] = ("arm",)
    spaces: tuple[str, ...] = ("ee_delta",)


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraSpec:
    """A camera a robot has, as far as planning must know: its name in topics and its role for
    backends.
    """

    name: str
    role: str


@dataclass(frozen=True, kw_only=True, slots=True)
class DriverSpec(Loadable):
    """One way to move a robot: "simulated", "hardware" ...; `target` is its RobotDriver class.

    Attributes:
        recovers: it can clear a fault that has stopped the robot, by a method `recover`; see
            rn-ops.
        simulated: nothing real moves. A driver that does not say so counts as one of a real robot.
    """

    recovers: bool = False
    simulated: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotSpec(Spec):
    """A robot model; `target` is a function without arguments that returns its `RobotProfile`.

    Attributes:
        robot_kind: "arm" or "base".
        drivers: at least one.
        cameras: what it sees with.
        action_widths: widths of model action spaces it can execute (7 for one arm and gripper);
            empty for bases.
    """

    kind: ClassVar[str] = "robot"

    robot_kind: str = "arm"
    drivers: tuple[DriverSpec, ...] = ()
    cameras: tuple[CameraSpec, ...] = ()
    action_widths: tuple[int, ...] = (7,)

    def driver(self, name: str) -> DriverSpec | None:
        """The driver of that name, or None."""
        return next((d for d in self.drivers if d.name == name), None)


@dataclass(frozen=True, kw_only=True, slots=True)
class FeatureSpec(Spec):
    """Something the server can do: tools, resources, a transport, reactions to events.

    Attributes:
        sections: top-level keys of roboneuron.toml that belong to it. Empty: one section, called as
            the feature with underscores, and `config` is the model of that section. Otherwise
            `config` has one field for each key.
        transports: values of `[server] transport` that it serves.
        brings: "module:attribute" of the descriptor class of a kind of its own; the module also
            holds the specification (`hookspec`) of its hook, `roboneuron_<kind>s`. Imported while
            plugins are discovered, so it must be as light as a plugin module. Its class attribute
            `beside` may name more classes of that module.
        needs: names of features without which it does not work.
        on_discovery: "module:attribute" of a function without arguments that every process calls
            while it discovers plugins (server, modules, commands); as light as a plugin module, and
            harmless when called again. None for none.
        on_join: "module:attribute" of a function that every module process calls with its
            `ModuleHost` once it has joined ROS; None for none. In the server, `start` is the place
            for that.
        module: "module:attribute" of the class of the modules called as the feature ("perception"
            or "inference"), called with a `ModuleHost`.
        module_plan: "module:attribute" of a light function that finds and compares what such a
            module consists of: called with Config and Registry, returns its
            `roboneuron.feature.Plan` or raises a RoboNeuronError.
        fleet: "module:attribute" of what serves a configuration with several robots: called with
            the Config and the state directory, returns a `roboneuron.server.surface.Served`; None
            when it does not do that.
        fleet_config: "module:attribute" of what reads a file with several robots, for a feature
            with `fleet`: called with the tables, the file's name for messages and the Registry,
                returns the Config.
        switch: name of an option, true or false, of its first section; `roboneuron serve --NAME`,
            NAME being the feature's, sets it to true. None for no such flag.
    """

    kind: ClassVar[str] = "feature"

    sections: tuple[str, ...] = ()
    transports: tuple[str, ...] = ()
    brings: str | None = None
    needs: tuple[str, ...] = ()
    on_discovery: str | None = None
    on_join: str | None = None
    module: str | None = None
    module_plan: str | None = None
    fleet: str | None = None
    fleet_config: str | None = None
    switch: str | None = None

    @property
    def keys(self) -> tuple[str, ...]:
        """Top-level keys of roboneuron.toml that belong to it."""
        if self.sections or self.config is None:
            return self.sections
        return (self.name.replace("-", "_"),)


@dataclass(frozen=True, kw_only=True, slots=True)
class CommandSpec(Spec):
    """A command of `roboneuron`, called by its name; `config` is not used.

    Attributes:
        brings: as in FeatureSpec.
    """

    kind: ClassVar[str] = "command"

    brings: str | None = None


PLUGIN_KINDS: dict[str, type[Spec]] = {
    spec.kind: spec
    for spec in (
        BackendSpec,
        RuntimeSpec,
        AccelerationSpec,
        PerceptionSpec,
        ControllerSpec,
        RobotSpec,
        FeatureSpec,
        CommandSpec,
    )
}
"""Descriptor class by kind, of the kinds that core knows; a feature may bring more."""
SCHEMA_KEY = "x-configuration-only"
"""True in the JSON schema of an option that is marked."""


@dataclass(frozen=True, slots=True)
class ConfigurationOnly:
    """Marks an option that only the configuration sets: a host, a file, a command, a variable.

    `url: Annotated[str, ConfigurationOnly()]`. An option without a mark counts as restricted when
    its type or name says that it names such a thing; `AgentMaySet()` lifts that. The feature that
    lets agents set options goes by this; `agent_options` of `[selection]` lists exceptions for
    admins.
    """

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Say so in the option's JSON schema."""
        return {**handler(schema), SCHEMA_KEY: True}


@dataclass(frozen=True, slots=True)
class AgentMaySet:
    """Marks an option whose type or name looks restricted, but that names nothing outside of the
    plugin.
    """
