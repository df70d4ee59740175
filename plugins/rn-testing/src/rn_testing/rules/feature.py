"""Rules of features: no effects at construction, good descriptions, start and close, and no bypass
of the gate.
"""

from __future__ import annotations

import ast
import re
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from rn_testing.attempts import attempt
from rn_testing.cases import FeatureCase
from rn_testing.deadline import bounded
from rn_testing.distribution import plugin_package
from rn_testing.effects import check_released, running
from rn_testing.fakes import fake_registry
from rn_testing.lifecycle import ALONE, PURE, check_pure_constructor
from rn_testing.process_state import find_changes
from rn_testing.rule import Rule, require

if TYPE_CHECKING:
    from mcp.types import Tool

    from roboneuron.feature import Application

_NAME = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_LEAVE_S = 5.0
_SENDER = "roboneuron.direct_path"
"""Package of the gate, the only feature that sends."""
_FORBIDDEN = (
    "rclpy",
    "roboneuron.command.RosLink",
    "roboneuron.direct_path.writer",
    "roboneuron.direct_path.traffic",
)
"""Modules that could publish without the gate."""


@contextmanager
def _server(case: FeatureCase, with_feature: bool = True) -> Iterator[Application]:
    """A server with the fakes and the feature, in its own folder; no module is started."""
    from roboneuron.feature import (
        Application,  # heavy
        Config,  # heavy
    )

    def refuse(python: str | None) -> NoReturn:
        raise AssertionError("a feature must not start a module by itself")

    config = Config.model_validate(
        {"robot": {"name": "gantry"}, "sections": case.sections() if with_feature else {}}
    )
    registry = fake_registry(*((case.spec, *case.needs) if with_feature else ()))
    with tempfile.TemporaryDirectory() as folder:
        application = Application(
            config, directory=Path(folder), plugins=lambda: registry, command=refuse
        )
        try:
            yield application
        finally:
            application.close()


def _check_class(case: FeatureCase) -> None:
    from roboneuron import Feature  # heavy

    made = attempt(case, case.build)
    require(
        isinstance(made, Feature),
        f"`target` makes a {type(made).__name__}, not a roboneuron.Feature",
    )


def _check_defaults(case: FeatureCase) -> None:
    model = case.options_model()
    if model is not None and not case.options:
        model.model_validate({})


def _check_loads(case: FeatureCase) -> None:
    with _server(case) as application:
        require(
            not application.features.failed,
            f"it was left out: {application.features.failed.get(case.spec.name)}",
        )


def _new_tools(case: FeatureCase) -> list[Tool]:
    with _server(case, with_feature=False) as bare:
        known = {tool.name for tool in bare.tools.listing()}
    with _server(case) as application:
        return [tool for tool in application.tools.listing() if tool.name not in known]


def _check_described(case: FeatureCase) -> None:
    for tool in _new_tools(case):
        who = f"the tool {tool.name!r}"
        require(_NAME.fullmatch(tool.name) is not None, f"{who} is not a snake_case name")
        # None is fine: it repeats the name, and is not listed
        require(tool.title != "", f"{who} has no title")
        require(
            len(tool.description or "") >= 20,
            f"the description of {who} says too little: {tool.description!r}",
        )
        properties: dict[str, Any] = tool.input_schema.get("properties", {})
        bare = [name for name, entry in properties.items() if not entry.get("description")]
        require(not bare, f"{who} has arguments without description: {', '.join(bare)}")
        require(
            tool.input_schema.get("additionalProperties") is False,
            f"{who} takes arguments that it does not name",
        )


def _check_closes(case: FeatureCase) -> None:
    before = running()
    made = attempt(case, case.build)
    made.close()
    made.close()
    with _server(case) as application:
        loaded = application.features.loaded.get(case.spec.name)
        require(loaded is not None, "it was left out of the server")
        assert loaded is not None
        feature = bounded(loaded, case.limits_s)
        feature.start(application.host)
        started_s = time.monotonic()
        feature.close()
        feature.close()
        took_s = time.monotonic() - started_s
        require(
            took_s < _LEAVE_S, f"`close` took {took_s:.1f} s, at most {_LEAVE_S:g} s are allowed"
        )
    check_released(before, "close()")


def _check_process(case: FeatureCase) -> None:
    def run() -> None:
        with _server(case) as application:
            feature = application.features.loaded.get(case.spec.name)
            if feature is not None:
                bounded(feature, case.limits_s).start(application.host)

    changes = find_changes(run)
    require(not changes, f"it {'; '.join(changes)}")


def _check_gate(case: FeatureCase) -> None:
    if case.spec.target == "roboneuron:Feature":
        # It provides a module and nothing to the server; control limits the module's requests.
        return
    package = plugin_package(case.spec.target.partition(":")[0])
    for path in _sources(package) if package != _SENDER else ():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
            for name in names:
                breach = any(name == word or name.startswith(f"{word}.") for word in _FORBIDDEN)
                require(
                    not breach,
                    f"{path.name} imports {name}: use host.gate for everything that moves a robot",
                )


def _sources(package: str) -> list[Path]:
    spec = find_spec(package)
    folders = list(spec.submodule_search_locations or ()) if spec is not None else []
    return sorted(path for folder in folders for path in Path(folder).rglob("*.py"))


_SOURCE = "roboneuron.server.feature.Feature"

RULES: tuple[Rule[FeatureCase], ...] = (
    Rule(
        id="feature/class",
        text="`target` makes a roboneuron.Feature.",
        source=_SOURCE,
        check=_check_class,
    ),
    Rule(id="feature/constructor-pure", text=PURE, source=_SOURCE, check=check_pure_constructor),
    Rule(
        id="feature/defaults",
        text="It works without a section in the configuration: every option has a default.",
        source=_SOURCE,
        check=_check_defaults,
    ),
    Rule(id="feature/loads", text="A server loads it.", source=_SOURCE, check=_check_loads),
    Rule(
        id="feature/tools-described",
        text="Its tools have snake_case names, titles, descriptions, and described arguments.",
        source=f"{_SOURCE}.tools",
        check=_check_described,
    ),
    Rule(
        id="feature/closes",
        text="`start`, `close` are quick; `close` may be called twice and before `start` and "
        "leaves nothing running.",
        source=f"{_SOURCE}.close",
        check=_check_closes,
    ),
    Rule(id="feature/process-left-alone", text=ALONE, source=_SOURCE, check=_check_process),
    Rule(
        id="feature/no-way-round-the-gate",
        text="Its package imports nothing that can publish without the gate.",
        source="roboneuron.server.host.Host",
        check=_check_gate,
    ),
)
"""Rules of features."""
