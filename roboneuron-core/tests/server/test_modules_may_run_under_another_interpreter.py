"""With `python` in its section a module runs under another interpreter, so its plugin's
requirements are not checked in the server.
"""

from __future__ import annotations

import pytest

from roboneuron.config import Config
from roboneuron.errors import ConfigurationError, RoboNeuronError
from roboneuron.planning import KIND_ENTRIES
from roboneuron.plugins.registry import Offer, Registry, Status
from roboneuron.plugins.specs import (
    BackendSpec,
    CameraSpec,
    ControllerSpec,
    DriverSpec,
    FeatureSpec,
    PerceptionSpec,
    Requirement,
    RobotSpec,
)

TARGET = "never_imported_module:Thing"
ABSENT = (Requirement(module="absent_x", install="pip install x"),)
ARM = RobotSpec(
    name="arm",
    summary="A.",
    target=TARGET,
    drivers=(DriverSpec(name="hardware", summary="H.", target=TARGET, requires=ABSENT),),
    cameras=(CameraSpec(name="front", role="primary"),),
)
PARTS = (
    PerceptionSpec(name="camera", summary="C.", target=TARGET, requires=ABSENT),
    ControllerSpec(name="ik", summary="I.", target=TARGET, requires=ABSENT),
    BackendSpec(name="policy", summary="P.", target=TARGET, requires=ABSENT),
)
FEATURES = tuple(
    FeatureSpec(
        name=kind,
        summary="F.",
        target=TARGET,
        module=TARGET,
        module_plan=f"roboneuron.modules.{kind}.planning:plan_{kind}",
    )
    for kind in ("perception", "inference", "control")
)
REGISTRY = Registry(
    plugins=(),
    all_offers=(
        *(
            Offer(spec=s, plugin="rn-test", distribution="rn-test", status=Status.READY)
            for s in (ARM, *FEATURES)
        ),
        *(
            Offer(
                spec=s,
                plugin="rn-test",
                distribution="rn-test",
                status=Status.UNAVAILABLE,
                reason="Needs 'absent_x'.",
            )
            for s in PARTS
        ),
    ),
)
SECTIONS = {
    "robot": {"name": "arm", "driver": "hardware"},
    "perception": {"source": "camera"},
    "control": {"controller": "ik"},
    "inference": {"backend": "policy"},
}


@pytest.mark.parametrize("kind", SECTIONS)
def test_its_plugin_needs_nothing_here(kind):
    sections = {
        name: {**section, "python": "/other/bin/python"} for name, section in SECTIONS.items()
    }
    plan = KIND_ENTRIES[kind].check(Config.model_validate(sections), REGISTRY)
    assert getattr(plan.config, kind).python == "/other/bin/python"
    del sections[kind]["python"]
    with pytest.raises(RoboNeuronError, match="absent_x"):
        KIND_ENTRIES[kind].check(Config.model_validate(sections), REGISTRY)


@pytest.mark.parametrize("kind", ["perception", "inference", "control"])
def test_a_module_that_no_feature_brings_is_refused_before_it_is_started(kind):
    offers = tuple(offer for offer in REGISTRY.all_offers if offer.spec not in FEATURES)
    registry = Registry(plugins=(), all_offers=offers)
    sections = {name: {**section, "python": "/x"} for name, section in SECTIONS.items()}
    with pytest.raises(ConfigurationError, match=f"There is no feature {kind!r}"):
        KIND_ENTRIES[kind].check(Config.model_validate(sections), registry)
    assert KIND_ENTRIES["robot"].check(Config.model_validate(sections), registry).plugin == "arm"
