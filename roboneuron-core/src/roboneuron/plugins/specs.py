"""Descriptors of plugins' offers, in terms of the standard library, so that they are listed without
being loaded.

`target` and `config` are written "package.module:attribute". `target` is called with the arguments
that the protocol of its kind names (see `roboneuron.contract.protocols`). `config` is a pydantic
model class whose fields are the options under `[plugins.<name>]`, or None without options.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from roboneuron.plugins.module_kind import ModuleKindSpec

CONTRACT_VERSION = 1
"""Incremented when a descriptor or protocol changes incompatibly with old plugins."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Requirement:
    """An importable module that a plugin needs beyond its own package.

    Attributes:
        module: top-level import name, searched for without importing it.
        install: the command that provides it, shown to the user.
        alternatives: modules that can each replace `module`.
    """

    module: str
    install: str
    alternatives: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class ActionSpace:
    """The chunks that a model family produces; the backend converts them to the contract's
    7-vector, or to the `space` that it declares.

    Attributes:
        width: values per step and arm set; planning refuses a width missing in the robot's
            `action_widths`.
        horizon: actions per inference.
        step_s: nominal time between two actions [s]; 0 if the checkpoint's profile defines it.
    """

    width: int = 7
    horizon: int = 1
    step_s: float = 0.1


@dataclass(frozen=True, kw_only=True, slots=True)
class Verb:
    """A kind of instruction that a policy follows, and when it is carried out: tasks judge it by
    themselves.

    Attributes:
        words: lower-case words of which any asks for it, such as "pick" or "grasp".
        achieves: one of `VERB_ENDS`.
    """

    words: tuple[str, ...]
    achieves: str


VERB_ENDS = ("lifted", "on")
"""Values of `Verb.achieves`. lifted: the hand holds the object that is named, above where it lay;
on: the first object lies on the one named after "on", let go.
"""
PICK_AND_PLACE = (
    Verb(words=("pick", "grasp", "grab", "lift"), achieves="lifted"),
    Verb(words=("put", "place", "stack", "set"), achieves="on"),
)
"""Verbs of a model that was trained on instructions in English to manipulate objects."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Loadable:
    """Base of descriptors: a name and a loadable target.

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
    """Fields of every descriptor.

    Attributes:
        contract: the CONTRACT_VERSION the plugin was written for.
        case: "module:attribute" of a function without arguments that returns this descriptor's
            contract case: the inputs with which `roboneuron plugins check` tests it (a valid
            observation, a small checkpoint); None if its default options and synthetic input
            suffice. Never loaded otherwise.
    """

    kind: ClassVar[str] = ""

    contract: int = CONTRACT_VERSION
    case: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class BackendSpec(Spec):
    """A policy, from image and instruction to actions.

    Attributes:
        cameras: roles of required frames, in order.
        optional_cameras: roles of frames used if the robot has them.
        needs_state: it reads joints, TCP pose and gripper of the observation.
        needs_checkpoint: `start_inference` must name a checkpoint directory (a pydantic field
            `checkpoint`).
        action_space: the model's own output.
        family: model family, matched with runtimes and accelerations; empty if it uses neither.
        runtimes_required: it cannot run without a runtime of its family.
        default_runtime: runtime used when the user names none; empty for none.
        capabilities: words accelerations may require of it.
        conditions_on_rows: it continues `Observation.ahead.rows` (real-time chunking), and reports
            their number in `ActionChunk.conditioned_rows`.
        max_committed_rows: longest prefix that it was trained to keep; 0 for any length.
        takes_predicted_state: it was trained on states ahead of the image and reads TCP pose and
            gripper only (joints cannot be predicted from TCP deltas); they may be predicted for the
            end of the running chunk.
        space: "module:attribute" of a function that returns the `ControlSpace` of its chunks or
            raises a RoboNeuronError; called with the options (a mapping, unchecked) and the robot's
            profile, before anything heavy is imported. It may read small files of the checkpoint,
            and returns None if only the loaded backend knows the space (`served_spec`). None for
            `ee_delta` always.
        verbs: instructions whose end a task judges by itself. Empty: a caller has to say when a
            task is done.
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
    verbs: tuple[Verb, ...] = ()


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
        robots: names of supported robots; empty for any.
        drivers: robot drivers it needs ("simulated" for a simulator's cameras); empty for any.
    """

    kind: ClassVar[str] = "perception"

    robots: tuple[str, ...] = ()
    drivers: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True)
class ControllerSpec(Spec):
    """Converter of actions to joint commands.

    Attributes:
        robot_kinds: supported kinds of robot ("arm", "base").
        spaces: kinds of control spaces that it executes; other than `ee_delta` with
            `SpaceController.execute`.
    """

    kind: ClassVar[str] = "controller"

    robot_kinds: tuple[str, ...] = ("arm",)
    spaces: tuple[str, ...] = ("ee_delta",)


@dataclass(frozen=True, kw_only=True, slots=True)
class LocatorSpec(Spec):
    """A finder of objects in calibrated pictures.

    Attributes:
        needs_depth: it works on pictures with depth only.
        limit_s: longest time of one answer for two pictures of 640 x 480 [s].
        takes_labels: its target is a `LabelLocator`.
        own_process: it is built, loaded and used in a process of its own, which is ended when an
            answer takes longer than `limit_s`: for heavy imports and native code.
        load_s: longest time that it loads there [s].
    """

    kind: ClassVar[str] = "locator"

    needs_depth: bool = False
    limit_s: float = 1.0
    takes_labels: bool = False
    own_process: bool = False
    load_s: float = 180.0


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraSpec:
    """A camera of a robot, as far as planning needs it: its name in topics and its role for
    backends.
    """

    name: str
    role: str


@dataclass(frozen=True, kw_only=True, slots=True)
class DriverSpec(Loadable):
    """A driver of a robot: "simulated", "hardware" ...; `target` is its RobotDriver class.

    Attributes:
        recovers: it can clear a fault that has stopped the robot, with a method `recover`; see
            rn-ops.
        simulated: nothing real moves. A driver without this flag counts as that of a real robot.
    """

    recovers: bool = False
    simulated: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class RobotSpec(Spec):
    """A robot model; `target` returns its `RobotProfile`, called with `declaration` if it has one.

    Attributes:
        robot_kind: "arm" or "base".
        drivers: at least one.
        cameras: cameras of the robot.
        action_widths: widths of the model action spaces that it executes; empty for bases.
        declaration: `[robot]` that declares it, see `FeatureSpec.declared_robot`; none in hooks.
    """

    kind: ClassVar[str] = "robot"

    robot_kind: str = "arm"
    drivers: tuple[DriverSpec, ...] = ()
    cameras: tuple[CameraSpec, ...] = ()
    action_widths: tuple[int, ...] = (7,)
    declaration: object | None = field(default=None, hash=False)

    def driver(self, name: str) -> DriverSpec | None:
        """The driver of that name, or None."""
        return next((d for d in self.drivers if d.name == name), None)


@dataclass(frozen=True, kw_only=True, slots=True)
class FeatureSpec(Spec):
    """An extension of the server: tools, resources, a transport, reactions to events.

    Attributes:
        sections: top-level keys of roboneuron.toml that belong to it, for each of which `config`
            has a field. Empty: one with the feature's name in underscores, whose model it is.
        transports: values of `[server] transport` that it serves.
        brings: "module:attribute" of the descriptor class of an additional kind; its module, as
            light as a plugin module, also has the specification (`hookspec`) of its hook,
            `roboneuron_<kind>s`. The class attribute `beside` may name more classes of it.
        needs: names of required features.
        on_discovery: "module:attribute" of a light, idempotent function without arguments that
            every process calls while it discovers plugins (server, modules, commands).
        on_join: "module:attribute" of a function that every module process calls with its
            `ModuleHost` once it has joined ROS; in the server, use `start` for that.
        module: "module:attribute" of the class of modules with the feature's name, such as
            "perception", called with a `ModuleHost`.
        module_plan: "module:attribute" of a light function that plans such a module: called with
            Config and Registry, returns its `roboneuron.feature.Plan` or raises a RoboNeuronError.
        module_kind: set for a further kind of modules, whose section is the feature's, with
            `start_timeout_s` and `python` as every kind. It needs no `module_plan`.
        fleet: "module:attribute" of a function that serves a configuration with several robots:
            called with Config and state directory, returns a `roboneuron.server.surface.Served`.
        fleet_config: "module:attribute" of a function that reads a file with several robots:
            called with the tables, the file's name and the Registry, returns the Config.
        declared_robot: "module:attribute" of a light function from `[robot]` to its `RobotSpec`.
        switch: boolean option of its first section; `roboneuron serve --<feature>` sets it.
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
    module_kind: ModuleKindSpec | None = None
    fleet: str | None = None
    fleet_config: str | None = None
    declared_robot: str | None = None
    switch: str | None = None

    @property
    def keys(self) -> tuple[str, ...]:
        """Top-level keys of roboneuron.toml that belong to it."""
        if self.sections or self.config is None:
            return self.sections
        return (self.name.replace("-", "_"),)


@dataclass(frozen=True, kw_only=True, slots=True)
class CommandSpec(Spec):
    """A command of `roboneuron`, with the descriptor's name; `config` is not used.

    Attributes:
        brings: as in FeatureSpec.
        group: word before the command's own, of an existing group (robot, runs, policy, ros, link,
            config, plugins, eval) or a new one; `name` is "GROUP-WORD" then, used as `roboneuron
            GROUP WORD`. Empty: a command of the top level.
        section: of `roboneuron --help`, for a command of the top level: "start", "operate", "group"
            (it has commands of its own), or empty for the last one.
        old_names: words after `roboneuron` that it had before, accepted with a note on standard
            error.
        old_options: pairs of an option's old and present name, accepted likewise.
    """

    kind: ClassVar[str] = "command"

    brings: str | None = None
    group: str = ""
    section: str = ""
    old_names: tuple[str, ...] = ()
    old_options: tuple[tuple[str, str], ...] = ()


COMMAND_SECTIONS = ("start", "operate", "group", "")
"""Values of `CommandSpec.section`, in the order of `roboneuron --help`."""
PLUGIN_KINDS: dict[str, type[Spec]] = {
    spec.kind: spec
    for spec in (
        BackendSpec,
        RuntimeSpec,
        AccelerationSpec,
        PerceptionSpec,
        ControllerSpec,
        RobotSpec,
        LocatorSpec,
        FeatureSpec,
        CommandSpec,
    )
}
"""Descriptor class by kind, for core's kinds; a feature may add more."""
