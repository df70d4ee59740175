"""Names that plugin authors import change only together with the list of changes."""

from __future__ import annotations

import inspect
import json
import re
import subprocess
import sys
from dataclasses import fields, is_dataclass
from functools import cached_property
from pathlib import Path

import pytest

import roboneuron

RECORD = Path(__file__).parent / "public_api.json"
ROOT = Path(__file__).parents[2]
CHANGES = (ROOT / "CHANGELOG.md", *sorted((ROOT / "changes").glob("+*.md")))


def _describe(name: str) -> object:
    """The public part of a name: fields of a dataclass, methods of a class, arguments of a
    function.
    """
    value = getattr(roboneuron, name)
    if isinstance(value, type):
        members = {
            member: _signature(function) if inspect.isfunction(function) else "property"
            for member, function in vars(value).items()
            if not member.startswith("_")
            and (inspect.isfunction(function) or isinstance(function, (property, cached_property)))
        }
        own = [f"{f.name}: {f.type}" for f in fields(value)] if is_dataclass(value) else []
        return {"fields": own, "members": members}
    return _signature(value) if inspect.isfunction(value) else type(value).__name__


def _signature(function: object) -> str:
    return re.sub(r"<function [^>]*>+( at 0x\w+>)?", "...", str(inspect.signature(function)))  # type: ignore[arg-type]


def test_the_api_is_as_recorded() -> None:
    """After a deliberate change: describe it in changes/, then run this file as a program."""
    now = {name: _describe(name) for name in sorted(roboneuron.__all__)}
    assert now == json.loads(RECORD.read_text(encoding="utf-8"))["names"]


def test_the_record_names_its_entry_in_the_changelog() -> None:
    entry = json.loads(RECORD.read_text(encoding="utf-8"))["changelog"]
    assert any(entry in path.read_text(encoding="utf-8") for path in CHANGES), (
        "the public API changed without an entry in changes/"
    )


def test_every_name_is_importable_and_documented() -> None:
    for name in roboneuron.__all__:
        value = getattr(roboneuron, name)
        if isinstance(value, type) or inspect.isfunction(value):
            assert inspect.getdoc(value), name


def test_importing_the_package_and_its_descriptors_stays_light() -> None:
    script = (
        "import sys; from roboneuron import BackendSpec, FeatureSpec, hookimpl; "
        "print([m for m in ('numpy', 'pydantic', 'mcp', 'rclpy', 'torch') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="Backendspec"):
        roboneuron.Backendspec  # noqa: B018


if __name__ == "__main__":
    newest = CHANGES[-1].read_text(encoding="utf-8").splitlines()[-1]
    entry = sys.argv[1] if len(sys.argv) > 1 else newest
    RECORD.write_text(
        json.dumps(
            {"changelog": entry, "names": {n: _describe(n) for n in sorted(roboneuron.__all__)}},
            indent=1,
        )
        + "\n",
        encoding="utf-8",
    )
