"""Every compiled type of the wheels as an oracle: bytes in both directions, descriptions, classes
with their defaults.
"""

from __future__ import annotations

import json
import random
import sys
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import rosidl_generator_py
from made_messages import filled
from rclpy.serialization import deserialize_message, serialize_message

from rn_interfaces.codec import codec
from rn_interfaces.definitions import by_package, outline
from rn_interfaces.generate import describe, write_class
from rn_interfaces.store import Name

SHARE = Path(sys.prefix) / "share"
SITE = Path(rosidl_generator_py.__file__).parents[1]
HEAD = b"\0\1\0\0"
"""Of plain CDR, little-endian."""


def compiled() -> list[Name]:
    """Every interface of the wheels that has a .msg, .srv or .action."""
    index = SHARE / "ament_index" / "resource_index" / "rosidl_interfaces"
    found = []
    for entry in sorted(index.iterdir()):
        for line in entry.read_text().split():
            kind, _, file = line.partition("/")
            word, _, suffix = file.rpartition(".")
            if suffix == kind and (SITE / entry.name / kind).is_dir():
                found.append(Name(entry.name, kind, word))
    return found


def classes(name: Name) -> list[type]:
    """The messages of an interface."""
    found: Any = getattr(import_module(f"{name.package}.{name.kind}"), name.word)
    if name.kind == "msg":
        return [found]
    if name.kind == "srv":
        return [found.Request, found.Response]
    goal, result = found.Impl.SendGoalService, found.Impl.GetResultService
    return [
        *(found.Goal, found.Result, found.Feedback, found.Impl.FeedbackMessage),
        *(goal.Request, goal.Response, result.Request, result.Response),
    ]


def test_messages_of_every_compiled_type_are_equal_both_ways() -> None:
    rng = random.Random(1)
    seen = 0
    for name in compiled():
        for cls in classes(name):
            ours = codec(cls)
            for message in (cls(), filled(cls, rng), filled(cls, rng)):
                theirs = serialize_message(message)
                written = HEAD + ours.encode(message)
                assert deserialize_message(written, cls) == message, cls
                assert ours.decode(theirs[4:]) == message, cls
                # the compiled ones reserve more than they write, and leave the rest as it was
                assert len(written) <= len(theirs), cls
                seen += 1
    assert seen > 700


@pytest.mark.parametrize("package", ["std_srvs", "diagnostic_msgs", "action_msgs"])
def test_descriptions_and_classes_are_those_of_the_wheels(package: str, tmp_path: Path) -> None:
    _compare([name for name in compiled() if name.package == package], tmp_path)


@pytest.mark.slow
def test_descriptions_and_classes_of_all_wheels_are_equal(tmp_path: Path) -> None:
    names = compiled()
    assert len(names) >= 208
    _compare(names, tmp_path)


def _compare(names: list[Name], work: Path) -> None:
    used = {one: outline(one, (SHARE / one.file).read_text()).used for one in names}
    packages = {path.name: path for path in SHARE.iterdir()}
    for chosen in by_package(used):
        package = chosen[0].package
        listed = [f"{one.kind}/{one.word}" for one in chosen]
        others = {name: path for name, path in packages.items() if name != package}
        with redirect_stdout(sys.stderr):
            describe(package, listed, SHARE, work, others)
            for name in listed:
                write_class(package, name, work)
        for one in chosen:
            path = one.file.with_suffix(".json")
            assert json.loads((work / path).read_text()) == json.loads((SHARE / path).read_text())
        for path in (work / package).glob("*/_*.py"):
            theirs = (SITE / package / path.parent.name / path.name).read_text()
            assert path.read_text() == theirs
