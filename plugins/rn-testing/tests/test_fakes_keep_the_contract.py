"""The public fakes keep every rule, through the contract classes that third parties use."""

from __future__ import annotations

import pytest

from rn_testing import (
    AccelerationCase,
    AccelerationContract,
    BackendCase,
    BackendContract,
    ControllerCase,
    ControllerContract,
    PerceptionCase,
    PerceptionContract,
    RobotCase,
    RobotContract,
    RuntimeCase,
    RuntimeContract,
    fakes,
)


class TestInstantBackend(BackendContract):
    @pytest.fixture
    def plugin(self) -> BackendCase:
        return BackendCase(spec=fakes.FAKE_BACKEND, options={"horizon": 4})


class TestCountingRuntime(RuntimeContract):
    @pytest.fixture
    def plugin(self) -> RuntimeCase:
        return RuntimeCase(
            spec=fakes.FAKE_RUNTIME,
            model=lambda: "model",
            request=lambda: "one two three four",
            bad_request=lambda: 3,
            acceleration=lambda: fakes.HalvingAcceleration(None),
        )


class TestHalvingAcceleration(AccelerationContract):
    @pytest.fixture
    def plugin(self) -> AccelerationCase:
        return AccelerationCase(spec=fakes.FAKE_ACCELERATION, decoder=fakes.FakeDecoder)


class TestControlledSource(PerceptionContract):
    @pytest.fixture
    def plugin(self) -> PerceptionCase:
        return PerceptionCase(
            spec=fakes.FAKE_PERCEPTION, feed=lambda source, topics: source.show("front")
        )


class TestGantryController(ControllerContract):
    @pytest.fixture
    def plugin(self) -> ControllerCase:
        return ControllerCase(spec=fakes.FAKE_CONTROLLER)


class TestGantry(RobotContract):
    @pytest.fixture
    def plugin(self) -> RobotCase:
        return RobotCase(spec=fakes.FAKE_ROBOT)


def test_the_fake_registry_resolves_a_whole_plan():
    from roboneuron.config import Config
    from roboneuron.planning import KIND_ENTRIES

    tables = {
        "robot": {"name": "gantry"},
        "perception": {"source": "controlled"},
        "control": {"controller": "gantry"},
        "inference": {"backend": "instant"},
    }
    config, registry = Config.model_validate(tables), fakes.fake_registry()
    plans = {kind: entry.plan(config, registry) for kind, entry in KIND_ENTRIES.items()}
    assert plans["inference"].names["cameras"] == "primary=front"


def test_memory_topics_hand_messages_to_subscribers():
    topics = fakes.MemoryTopics(now_ns=lambda: 5)
    received: list[str] = []
    topics.subscribe("words", str, received.append)
    topics.advertise("words", str)("hello")
    topics.deliver("words", "again")
    assert (received, topics.published("words"), topics.now_ns()) == (
        ["hello", "again"],
        ("hello",),
        5,
    )


def test_memory_topics_refuse_another_message_type():
    publish = fakes.MemoryTopics().advertise("words", str)
    with pytest.raises(TypeError, match="words carries str, got int"):
        publish(3)  # type: ignore[arg-type]
