"""Tools that list the installed backends, runtimes, accelerations, sources, controllers and
robots.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, TypeVar

from pydantic import Field

from roboneuron.config.models import Config, InferenceConfig
from roboneuron.errors import RoboNeuronError
from roboneuron.planning import KIND_ENTRIES
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import (
    AccelerationSpec,
    BackendSpec,
    ControllerSpec,
    PerceptionSpec,
    RobotSpec,
    RuntimeSpec,
    Spec,
)
from roboneuron.selection.permission import check_addresses
from roboneuron.server.host import Host
from roboneuron.server.tool import CallContext, NoArguments, Result, Tool

S = TypeVar("S", bound=Spec)


class CatalogueEntry(Result):
    """One installed offer."""

    name: str
    summary: str
    package: str = Field(description="the distribution it comes from")
    status: str = Field(
        description="ready, or why it cannot be used: not ready (as configured), disabled, "
        "unavailable, incompatible ..."
    )
    reason: str = Field(default="", description="why it is not ready, and what to do")


class BackendEntry(CatalogueEntry):
    """A policy."""

    needs_checkpoint: bool = Field(description="start_inference must name a checkpoint directory")
    needs_state: bool = Field(
        description="it reads joints and end-effector pose, so control must run"
    )
    cameras: list[str] = Field(description="camera roles it needs")
    optional_cameras: list[str]
    family: str = Field(
        description="model family; empty when it takes neither runtime nor acceleration"
    )
    default_runtime: str
    runtimes: list[str] = Field(description="installed runtimes that fit")
    accelerations: list[str] = Field(description="installed accelerations that know its family")
    verbs: list[str] = Field(description="run_task judges by itself, without `until`")


class RuntimeEntry(CatalogueEntry):
    """An engine that executes models."""

    families: list[str]
    capabilities: list[str]
    served: bool = Field(description="the model runs in another process or on another host")


class AccelerationEntry(CatalogueEntry):
    """A preset."""

    families: list[str]
    capability: str = Field(description="what the runtime must offer")


class PerceptionSourceEntry(CatalogueEntry):
    """A source of images."""

    robots: list[str] = Field(description="robots it serves; any when empty")
    drivers: list[str] = Field(description="robot drivers it needs; any when empty")


class ControllerEntry(CatalogueEntry):
    """A controller, which converts actions to joint commands."""

    robot_kinds: list[str]


class Driver(Result):
    """A driver of a robot."""

    name: str
    summary: str
    kind: Literal["real", "simulated"] = Field(
        description="real unless the driver declares that it is simulated"
    )
    configured: bool = Field(description="start_robot uses it when nothing else is named")


class CameraEntry(Result):
    """A camera of a robot."""

    name: str
    role: str


class Robot(CatalogueEntry):
    """A robot model."""

    kind: str
    configured: bool = Field(description="start_robot starts it when nothing else is named")
    drivers: list[Driver]
    cameras: list[CameraEntry]


class Backends(Result):
    """Answer of list_backends."""

    backends: list[BackendEntry]


class Runtimes(Result):
    """Answer of list_runtimes."""

    runtimes: list[RuntimeEntry]


class Accelerations(Result):
    """Answer of list_accelerations."""

    accelerations: list[AccelerationEntry]


class PerceptionSources(Result):
    """Answer of list_perception_sources."""

    perception_sources: list[PerceptionSourceEntry]


class Controllers(Result):
    """Answer of list_controllers."""

    controllers: list[ControllerEntry]


class Robots(Result):
    """Answer of list_robots."""

    robots: list[Robot]


def _offered(registry: Registry, kind: type[S]) -> Iterator[tuple[S, dict[str, str]]]:
    """Yield each descriptor of a kind, with the fields common to all kinds."""
    for offer in registry.offers(kind.kind):
        if isinstance(offer.spec, kind):
            yield (
                offer.spec,
                {
                    "name": offer.spec.name,
                    "summary": offer.spec.summary,
                    "package": offer.distribution,
                    "status": str(offer.status),
                    "reason": offer.reason,
                },
            )


def _readiness(registry: Registry, config: Config, backend: str) -> dict[str, str]:
    """Whether a usable backend could be started with this configuration, and why not."""
    section = config.inference
    try:
        if section is None or section.backend != backend:
            section = InferenceConfig(backend=backend)
            check_addresses(registry.get(BackendSpec, backend), config.options(backend))
        KIND_ENTRIES["inference"].check(config.model_copy(update={"inference": section}), registry)
    except RoboNeuronError as error:
        return {"status": "not ready", "reason": str(error)}
    return {}


def backends(registry: Registry, config: Config) -> Backends:
    """All backends, with the runtimes and accelerations that fit each."""
    runtimes, accelerations = registry.specs(RuntimeSpec), registry.specs(AccelerationSpec)
    ready = registry.specs(BackendSpec)
    return Backends(
        backends=[
            BackendEntry(
                **common | (_readiness(registry, config, spec.name) if spec.name in ready else {}),
                needs_checkpoint=spec.needs_checkpoint,
                needs_state=spec.needs_state,
                cameras=list(spec.cameras),
                optional_cameras=list(spec.optional_cameras),
                family=spec.family,
                default_runtime=spec.default_runtime,
                runtimes=[
                    r.name for r in runtimes.values() if spec.family and spec.family in r.families
                ],
                accelerations=[
                    a.name
                    for a in accelerations.values()
                    if spec.family and spec.family in a.families
                ],
                verbs=[word for verb in spec.verbs for word in verb.words],
            )
            for spec, common in _offered(registry, BackendSpec)
        ]
    )


def runtimes(registry: Registry) -> Runtimes:
    """All runtimes."""
    return Runtimes(
        runtimes=[
            RuntimeEntry(
                **common,
                families=list(spec.families),
                capabilities=list(spec.capabilities),
                served=spec.served,
            )
            for spec, common in _offered(registry, RuntimeSpec)
        ]
    )


def accelerations(registry: Registry) -> Accelerations:
    """All acceleration presets."""
    return Accelerations(
        accelerations=[
            AccelerationEntry(**common, families=list(spec.families), capability=spec.capability)
            for spec, common in _offered(registry, AccelerationSpec)
        ]
    )


def perception_sources(registry: Registry) -> PerceptionSources:
    """All sources of images."""
    return PerceptionSources(
        perception_sources=[
            PerceptionSourceEntry(**common, robots=list(spec.robots), drivers=list(spec.drivers))
            for spec, common in _offered(registry, PerceptionSpec)
        ]
    )


def controllers(registry: Registry) -> Controllers:
    """All controllers."""
    return Controllers(
        controllers=[
            ControllerEntry(**common, robot_kinds=list(spec.robot_kinds))
            for spec, common in _offered(registry, ControllerSpec)
        ]
    )


def robots(registry: Registry, configured: Config) -> Robots:
    """All robots; `configured` determines the configured robot and driver."""
    chosen = configured.robot
    return Robots(
        robots=[
            Robot(
                **common,
                kind=spec.robot_kind,
                configured=spec.name == chosen.name,
                drivers=[
                    Driver(
                        name=driver.name,
                        summary=driver.summary,
                        kind="simulated" if driver.simulated else "real",
                        configured=(spec.name, driver.name) == (chosen.name, chosen.driver),
                    )
                    for driver in spec.drivers
                ],
                cameras=[CameraEntry(name=c.name, role=c.role) for c in spec.cameras],
            )
            for spec, common in _offered(registry, RobotSpec)
        ]
    )


_LISTS: tuple[tuple[str, str, type[Result], object], ...] = (
    (
        "list_robots",
        "robots, with their drivers (real or simulated, and which one is configured) and cameras",
        Robots,
        robots,
    ),
    ("list_perception_sources", "sources of camera images", PerceptionSources, perception_sources),
    ("list_controllers", "controllers", Controllers, controllers),
    (
        "list_backends",
        "backends (policies), with the runtimes and accelerations that fit each",
        Backends,
        backends,
    ),
    ("list_runtimes", "runtimes that execute models for backends", Runtimes, runtimes),
    ("list_accelerations", "acceleration presets", Accelerations, accelerations),
)


def catalogue_tools(host: Host) -> list[Tool[NoArguments]]:
    """Create one tool for each kind of plugin."""

    def tool(name: str, what: str, result: type[Result], build: Any) -> Tool[NoArguments]:
        async def handler(_: NoArguments, context: CallContext) -> Result:
            configured = {Robots: host.loop.base, Backends: host.loop.config}.get(result)
            given = (host.registry,) if configured is None else (host.registry, configured)
            answer: Result = build(*given)
            return answer

        return Tool(
            name=name,
            title=f"List {name.removeprefix('list_').replace('_', ' ')}",
            description=f"List the installed {what}.",
            arguments=NoArguments,
            result=result,
            handler=handler,
            read_only=True,
            idempotent=True,
            seldom=True,
        )

    return [tool(*entry) for entry in _LISTS]
