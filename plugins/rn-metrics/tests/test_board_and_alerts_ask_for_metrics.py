"""The board for Grafana and the alert rules for Prometheus ask only for metrics, labels and values
that there are.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml

from rn_metrics.meters import OUTCOMES, Meters
from rn_metrics.plugin import FEATURE
from rn_standard.http.plugin import FEATURE as HTTP
from rn_testing.fakes import fake_registry
from roboneuron.config import parse_config
from roboneuron.gate.audit import AuditRecord
from roboneuron.server.app import Application
from roboneuron.supervisor.health import Health

GRAFANA = Path(__file__).parents[3] / "docs" / "grafana"
BOARD = json.loads((GRAFANA / "roboneuron.json").read_text())
RULES = yaml.safe_load((GRAFANA / "alerts.yml").read_text())
ALERTS = [rule for group in RULES["groups"] for rule in group["rules"]]
EXPRESSIONS = [target["expr"] for panel in BOARD["panels"] for target in panel.get("targets", ())]
SELECTOR = re.compile(r"\b(roboneuron_\w+)(?:\{([^}]*)\})?")
MATCHER = re.compile(r'(\w+)\s*(=~|!~|!=|=)\s*"([^"]*)"')
DURATION = re.compile(r"\d+(ms|s|m|h|d)")
OF_PROMETHEUS = {"instance", "job"}
SUFFIXES = {"counter": ("_total",), "histogram": ("_bucket", "_sum", "_count")}


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Labels of each metric, when everything that can be counted has been counted once."""
    registry = fake_registry(HTTP, FEATURE)
    application = Application(
        parse_config('[robot]\nname = "gantry"\n[metrics]\nprometheus = true\nport = 0\n'),
        plugins=lambda: registry,
        directory=tmp_path_factory.mktemp("state"),
        command=lambda python: pytest.fail("not spawned"),
    )
    try:
        feature: Any = application.features.loaded.get("metrics")
        meters: Meters = feature.meters
        meters.calls.labels("t", "ok")
        meters.call_s.labels("t")
        meters.faults.labels("control", "exited")
        meters.switches.labels("control", "ok")
        meters.latency_s.labels("control")
        meters.task_s.labels("succeeded")
        meters.on_decision(
            AuditRecord(who="a", role="admin", tool="t", endpoint="e", verdict="refused", rule="r")
        )
        found: dict[str, set[str]] = {}
        for family in meters.registry.collect():
            labels = {label for sample in family.samples for label in sample.labels}
            labels |= set(getattr(family, "_labelnames", ()))
            for suffix in SUFFIXES.get(family.type, ("",)):
                found[f"{family.name}{suffix}"] = labels | {"robot"}
        return found
    finally:
        application.close()


def asked(expressions: list[str]) -> list[tuple[str, list[tuple[str, str, str]]]]:
    """Each metric with its matchers."""
    return [
        (name, MATCHER.findall(inner or ""))
        for expr in expressions
        for name, inner in SELECTOR.findall(expr)
    ]


@pytest.mark.parametrize(
    "expressions", [EXPRESSIONS, [rule["expr"] for rule in ALERTS]], ids=["board", "alerts"]
)
def test_metrics_and_labels_exist(exported: dict[str, set[str]], expressions: list[str]) -> None:
    found = asked(expressions)
    assert len(found) >= 10
    for name, matchers in found:
        assert name in exported, name
        for label, _, _ in matchers:
            assert label in exported[name] | OF_PROMETHEUS, (
                f"{name} has no label {label}: {exported[name]}"
            )
    for expr in expressions:
        for clause in re.findall(r"\bby \(([^)]*)\)", expr):
            known = (
                {"le"} | OF_PROMETHEUS | set().union(*(exported[name] for name, _ in asked([expr])))
            )
            assert {label.strip() for label in clause.split(",")} <= known, expr


@pytest.mark.parametrize("expr", [*EXPRESSIONS, *(rule["expr"] for rule in ALERTS)])
def test_expressions_are_whole(expr: str) -> None:
    for opening, closing in ("()", "{}", "[]"):
        assert expr.count(opening) == expr.count(closing), expr
    assert all(
        DURATION.fullmatch(span) or span == "$__range" for span in re.findall(r"\[([^]]*)\]", expr)
    ), expr
    for function in re.findall(r"\b(?:rate|increase)\(([^()]*)\)", expr):
        assert re.search(r"_(total|bucket|count|sum)\b", function), f"{function} is no counter"
        assert "[" in function


def test_values_of_labels_exist() -> None:
    values = {"health": set(get_args(Health)), "outcome": set(OUTCOMES)}
    modules = {"robot", "perception", "inference", "control"}
    for name, matchers in asked([*EXPRESSIONS, *(rule["expr"] for rule in ALERTS)]):
        for label, operator, wanted in matchers:
            known = values.get(label) or (modules if label == "module" else None)
            if known is not None and operator in ("=", "=~"):
                assert set(wanted.split("|")) <= known, f"{name}: {label} {wanted}"


def test_every_panel_tells_robots_apart() -> None:
    names = [variable["name"] for variable in BOARD["templating"]["list"]]
    assert names == ["datasource", "instance", "robot"]
    for panel in BOARD["panels"]:
        for target in panel["targets"]:
            assert 'robot=~"$robot"' in target["expr"], panel["title"]
            assert "{{robot}}" in target["legendFormat"], panel["title"]
    assert len({panel["id"] for panel in BOARD["panels"]}) == len(BOARD["panels"])
    places = [
        (x, y)
        for panel in BOARD["panels"]
        for x in range(panel["gridPos"]["x"], panel["gridPos"]["x"] + panel["gridPos"]["w"])
        for y in range(panel["gridPos"]["y"], panel["gridPos"]["y"] + panel["gridPos"]["h"])
    ]
    assert len(places) == len(set(places)), "panels overlap"


def test_rules_are_as_prometheus_wants_them() -> None:
    assert set(RULES) == {"groups"}
    assert len({rule["alert"] for rule in ALERTS}) == len(ALERTS) >= 8
    for rule in ALERTS:
        assert set(rule) <= {"alert", "expr", "for", "keep_firing_for", "labels", "annotations"}
        assert re.fullmatch(r"[A-Za-z_]\w*", rule["alert"])
        assert DURATION.fullmatch(rule.get("for", "0s"))
        assert rule["labels"]["severity"] in ("warning", "critical")
        assert set(rule["annotations"]) == {"summary", "description"}
        for label in re.findall(r"\$labels\.(\w+)", str(rule["annotations"])):
            by = re.findall(r"\bby \(([^)]*)\)", rule["expr"])
            kept = [{name.strip() for name in clause.split(",")} for clause in by]
            assert all(label in names for names in kept), (
                f"{rule['alert']} has no label {label} left"
            )


@pytest.mark.parametrize(
    "about",
    ["module_health", "emergency_stop", "late_action", "old_", "age_seconds", "tasks_total"],
)
def test_what_people_must_know_of_has_an_alert(about: str) -> None:
    assert any(about in rule["expr"] for rule in ALERTS)


def test_reasons_of_drops_are_those_that_modules_count() -> None:
    """They are words in the modules' code."""
    import roboneuron.modules
    import roboneuron.modules.control
    import roboneuron.modules.inference
    import roboneuron.modules.perception

    packages = (
        roboneuron.modules,
        roboneuron.modules.control,
        roboneuron.modules.inference,
        roboneuron.modules.perception,
    )
    folders = [Path(str(package.__file__)).parent for package in packages]
    code = "\n".join(path.read_text() for folder in folders for path in folder.glob("*.py"))
    for word in ("late_action", "stale_command", "no_frame"):
        assert f'"{word}"' in code
    for word in ('return "old"', '"future"', 'f"{doubt}_{what}"'):
        assert word in code
