"""An endpoint whose type cannot be used is named and left out; all others work."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from roboneuron.cli.main import main
from roboneuron.direct_path.fields import load_type
from roboneuron.direct_path.interface_class import UnusableTypeError
from roboneuron.server.app import Application
from roboneuron.tools.loop.results import StatusResult
from roboneuron.tools.loop.status import status
from roboneuron.tools.ros.interfaces import load_interface
from roboneuron.tools.ros.options import ExposeConfig
from roboneuron.tools.ros.plugin import FEATURE

Make = Callable[..., Application]
PACKAGE = "broken_msgs"
CLASSES = """
from importlib import import_module


def made(fields):
    return {"get_fields_and_field_types": classmethod(lambda cls: fields), "SLOT_TYPES": ()}


def __getattr__(name):
    if name == "Word":
        exec("def f(self, from): pass")
    if name == "Name":
        return limit
    if name == "Build":
        return import_module("broken_msgs.msg._not_there").Build
    kind, _, level = name.partition("Level")
    if kind in ("Deep", "Double") and level.isdigit():
        below = f"broken_msgs/{kind}Level{int(level) - 1}"
        fields = {"a": below, "b": below} if kind == "Double" else {"a": f"sequence<{below}>"}
        globals()[name] = type(name, (), made(fields if int(level) else {"a": "double"}))
        return globals()[name]
    raise AttributeError(name)
"""
BROKEN = {
    "Word": "SyntaxError",
    "Name": "NameError",
    "Build": "_not_there",
    "DeepLevel32": "33 levels",
    "DeepLevel600": "",
    "DoubleLevel30": "fields",
    "None": "is called",
}


@pytest.fixture
def broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package of messages that cannot be used."""
    (tmp_path / "msg").mkdir()
    (tmp_path / "msg" / "__init__.py").write_text(CLASSES)
    module = ModuleType(PACKAGE)
    spec = ModuleSpec(PACKAGE, None, is_package=True)
    spec.submodule_search_locations = module.__path__ = [str(tmp_path)]
    module.__spec__ = spec
    monkeypatch.setitem(sys.modules, PACKAGE, module)
    monkeypatch.delitem(sys.modules, f"{PACKAGE}.msg", raising=False)


def exposing(word: str, kind: str = "read") -> str:
    """An entry with a type of that package."""
    return (
        f'[[expose]]\nname = "{word.lower()}"\nkind = "{kind}"\ntopic = "/{word}"\n'
        f'type = "{PACKAGE}/msg/{word}"\n'
    )


GOOD = (
    '[[expose]]\nname = "good"\nkind = "read"\ntopic = "/good"\ntype = "geometry_msgs/msg/Twist"\n'
)


@pytest.mark.parametrize("word", BROKEN)
@pytest.mark.parametrize("load", [load_type, load_interface])
def test_a_type_that_cannot_be_used_is_one_kind_of_error(
    load: Callable[[str], object], word: str, broken: None
) -> None:
    with pytest.raises(UnusableTypeError) as caught:
        load(f"{PACKAGE}/msg/{word}")
    assert BROKEN[word] in str(caught.value)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize("kind", ["read", "publish"])
def test_the_server_works_without_them_and_says_so(
    kind: str, broken: None, make_application: Make, caplog: pytest.LogCaptureFixture
) -> None:
    entries = "".join(exposing(word, kind) for word in BROKEN)
    application = make_application(f'[robot]\nname = "rover"\n{entries}{GOOD}')
    names = {tool.name for tool in application.tools.listing()}
    assert "read_good" in names
    assert not any(word.lower() in name for word in BROKEN for name in names)
    left_out: Any = StatusResult.model_validate(status(application.host)).left_out
    assert len(left_out) == len(BROKEN)
    for word, reason in zip(BROKEN, left_out, strict=True):
        assert f"{word.lower()!r}" in reason
        assert BROKEN[word] in reason
        assert f"Left out: {reason}" in caplog.text
    application.features.loaded[FEATURE.name].refresh()  # type: ignore[attr-defined]
    assert caplog.text.count("Left out: ") == len(BROKEN)


def test_an_admin_is_refused_one(broken: None, make_application: Make) -> None:
    application = make_application('[robot]\nname = "rover"\n')
    tools: Any = application.features.loaded[FEATURE.name]
    entry = ExposeConfig(name="word", kind="read", topic="/word", type=f"{PACKAGE}/msg/Word")
    admin: Any = SimpleNamespace(who="a", role="admin", tool="expose_endpoint", arguments={})
    with pytest.raises(UnusableTypeError):
        tools.expose(entry, admin)
    assert not application.features.omitted


def test_config_check_names_them(
    broken: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "roboneuron.toml"
    head = f'[robot]\nname = "diffdrive"\n[supervisor]\nstate_directory = "{tmp_path}/state"\n'
    path.write_text(head + GOOD)
    assert main(["config", "check", str(path)]) == 0
    path.write_text(head + exposing("Word") + GOOD)
    assert main(["config", "check", str(path)]) == 1
    assert "'word'" in capsys.readouterr().err


def test_a_default_that_json_cannot_hold_is_left_out_of_the_schema() -> None:
    from dataclasses import replace

    from roboneuron.tools.ros.interfaces.schema import make_schema

    interface: Any = load_interface("geometry_msgs/msg/Point")
    fields = tuple(
        replace(field, default=default)
        for field, default in zip(
            interface.fields, (float("nan"), 1.5, [float("inf")]), strict=True
        )
    )
    schema: Any = make_schema(replace(interface.message, fields=fields))
    assert json.dumps(schema, allow_nan=False)
    assert {name for name, one in schema["properties"].items() if "default" in one} == {"y"}
