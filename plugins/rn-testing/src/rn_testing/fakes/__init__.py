"""Working fakes for every kind of plugin and for the ROS graph, without ROS, models or hardware.

They satisfy the contract themselves: the kit's own tests run every rule on them.
"""

from collections.abc import Mapping

from rn_testing.fakes.backend import FAKE_BACKEND, InstantBackend, InstantOptions, make_observation
from rn_testing.fakes.controller import FAKE_CONTROLLER, GantryController
from rn_testing.fakes.engine import (
    FAKE_ACCELERATION,
    FAKE_RUNTIME,
    CountingRuntime,
    FakeDecoder,
    HalvingAcceleration,
)
from rn_testing.fakes.perception import FAKE_PERCEPTION, ControlledSource, gradient_image
from rn_testing.fakes.robot import FAKE_ROBOT, FakeDriver, FakeDriverOptions, gantry_profile
from rn_testing.fakes.topics import MemoryTopics
from roboneuron import FeatureSpec, Spec
from roboneuron.command import Offer, PluginRecord, Status
from roboneuron.feature import Config, ModuleKind, Plan, Registry

FAKE_SPECS: tuple[Spec, ...] = (
    FAKE_BACKEND,
    FAKE_RUNTIME,
    FAKE_ACCELERATION,
    FAKE_PERCEPTION,
    FAKE_CONTROLLER,
    FAKE_ROBOT,
)
"""One descriptor of each kind."""


_MODULES = tuple(
    FeatureSpec(
        name=kind,
        summary=f"Brings {kind} modules.",
        target="roboneuron:Feature",
        module=f"roboneuron.modules.{kind}.module:{kind.title()}Module",
        module_plan=f"roboneuron.modules.{kind}.planning:plan_{kind}",
    )
    for kind in ("control", "inference", "perception")
)
_TOOLS = FeatureSpec(
    name="tools-loop",
    summary="Tools of the closed loop.",
    target="roboneuron.tools.loop.feature:LoopTools",
)


def fake_plan(
    kind: ModuleKind, config: Config, *inputs: ModuleKind, names: Mapping[str, str] | None = None
) -> Plan:
    """Plan of a module, independent of the installed plugins: with the fake robot, whose driver is
    not checked for compatibility.
    """
    return Plan(
        kind=kind,
        config=config,
        robot=FAKE_ROBOT,
        driver=FAKE_ROBOT.drivers[0],
        spec=FAKE_ROBOT.drivers[0],
        names=names or {},
        inputs=inputs,
    )


def fake_registry(*more: Spec) -> Registry:
    """A registry with the fakes, the plugins of their modules, the tools that start these, and
    `more`, all ready, as if offered by one plugin.
    """
    specs = (*FAKE_SPECS, *_MODULES, _TOOLS, *more)
    offers = tuple(
        Offer(spec=s, plugin="rn-fakes", distribution="rn-fakes", status=Status.READY)
        for s in specs
    )
    record = PluginRecord(
        name="rn-fakes",
        distribution="rn-fakes",
        version="1.0",
        module="rn_testing.fakes",
        status=Status.READY,
        offers=offers,
    )
    return Registry(plugins=(record,), all_offers=offers)


__all__ = [
    "FAKE_ACCELERATION",
    "FAKE_BACKEND",
    "FAKE_CONTROLLER",
    "FAKE_PERCEPTION",
    "FAKE_ROBOT",
    "FAKE_RUNTIME",
    "FAKE_SPECS",
    "ControlledSource",
    "CountingRuntime",
    "FakeDecoder",
    "FakeDriver",
    "FakeDriverOptions",
    "GantryController",
    "HalvingAcceleration",
    "InstantBackend",
    "InstantOptions",
    "MemoryTopics",
    "fake_registry",
    "gantry_profile",
    "gradient_image",
    "make_observation",
]
