"""Definitions with arbitrary fields: learnt, imported, encoded and decoded without colcon."""

from __future__ import annotations

import random
from importlib import import_module
from pathlib import Path

import pytest
from made_messages import definition, filled
from made_packages import write_package
from rclpy.serialization import deserialize_message, serialize_message

from rn_interfaces.learning import learn
from rn_interfaces.sources import definitions
from rn_interfaces.store import DefinitionStore


def round_trip(folder: Path, package: str, count: int) -> None:
    """Learn a package of `count` messages; each is sent through rclpy's own functions."""
    rng = random.Random(count)
    files: dict[str, str] = {}
    for index in range(count):
        earlier = [f"Made{one}" for one in range(max(0, index - 5), index)]
        files[f"msg/Made{index}.msg"] = definition(rng, earlier[-3:])
    files["msg/All.msg"] = "".join(f"Made{index} made{index}\n" for index in range(count))
    learnt = learn(DefinitionStore(), definitions(write_package(folder, package, files)))
    assert not learnt.refused
    assert len(learnt.added) == count + 1
    module = import_module(f"{package}.msg")
    assert len(module.All.SLOT_TYPES) == count  # whose classes one process makes
    for index in range(count):
        cls = getattr(module, f"Made{index}")
        default = cls()
        assert (default.speed, default.label, list(default.three)) == (1.5, "it's", [1, 2, 3])
        assert (cls.LIMIT, cls.WORD) == (7, "aaa")
        for message in (default, filled(cls, rng)):
            assert deserialize_message(serialize_message(message), cls) == message


@pytest.mark.parametrize("count", [6, pytest.param(30, marks=pytest.mark.exhaustive)])
def test_generated_definitions_round_trip(user: Path, tmp_path: Path, count: int) -> None:
    round_trip(tmp_path, f"made_{count}_msgs", count)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_thousand_generated_definitions_round_trip(user: Path, tmp_path: Path) -> None:
    round_trip(tmp_path, "made_thousand_msgs", 1000)
