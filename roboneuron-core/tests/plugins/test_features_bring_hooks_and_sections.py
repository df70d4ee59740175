"""A feature or a command may bring its own hooks; two plugins must not own one section."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from roboneuron.plugins.discovery import discover
from roboneuron.plugins.registry import Status

EVALUATION = '''
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar
from roboneuron import FeatureSpec, Spec, hookimpl, hookspec

@dataclass(frozen=True, kw_only=True, slots=True)
class SuiteSpec(Spec):
    """A suite of tasks."""
    kind: ClassVar[str] = "suite"
    tasks: int = 1

@hookspec
def roboneuron_suites() -> Sequence[SuiteSpec]:
    """Offer suites."""

@hookimpl
def roboneuron_features():
    return [FeatureSpec(name="evaluation", summary="Evaluates.", target="m:F", brings="{module}:{table}")]
'''  # noqa: E501
CUBES = """
from {module} import SuiteSpec
from roboneuron import hookimpl

@hookimpl
def roboneuron_suites():
    return [SuiteSpec(name="cubes", summary="Cubes on a table.", target="m:Cubes", tasks=3)]
"""
SECTION = """
from roboneuron import FeatureSpec, hookimpl

@hookimpl
def roboneuron_features():
    return [FeatureSpec(name="{name}", summary="Has a section.", target="m:F", config="m:C", sections=("shared",))]
"""  # noqa: E501


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    monkeypatch.syspath_prepend(str(tmp_path))
    known = set(sys.modules)

    def make(**sources: str) -> list[EntryPoint]:
        for name, text in sources.items():
            (tmp_path / f"{name}.py").write_text(text)
        return [EntryPoint(name=name, value=name, group="roboneuron") for name in sources]

    yield make
    for name in set(sys.modules) - known:
        del sys.modules[name]


@pytest.mark.parametrize("kind", ["Feature", "Command"])
def test_a_plugin_offers_what_a_feature_or_command_asks_for(write, kind):
    feature = EVALUATION.replace("{module}", "evaluation_one").replace("{table}", "SuiteSpec")
    feature = feature.replace("Feature", kind).replace("features", f"{kind.lower()}s")
    registry = discover(
        points=write(a_suite=CUBES.format(module="evaluation_one"), evaluation_one=feature)
    )
    assert [p.status for p in registry.plugins] == [Status.READY, Status.READY]
    assert registry.get(registry.kinds["suite"], "cubes").tasks == 3
    assert "suite" in registry.kinds


BESIDE = """
@dataclass(frozen=True, kw_only=True, slots=True)
class BoatTripSpec(Spec):
    kind: ClassVar[str] = "boat-trip"

@hookspec
def roboneuron_boat_trips() -> Sequence[BoatTripSpec]: ...

SuiteSpec.beside = (BoatTripSpec,)

@hookimpl
def roboneuron_boat_trips():
    return [BoatTripSpec(name="upriver", summary="Goes upriver.", target="m:Boat")]
"""


def test_a_descriptor_class_brings_others_of_its_module(write):
    text = EVALUATION.replace("{module}", "evaluation_beside").replace("{table}", "SuiteSpec")
    registry = discover(points=write(evaluation_beside=text + BESIDE))
    assert registry.plugins[0].status is Status.READY, registry.plugins[0].reason
    assert registry.get(registry.kinds["boat-trip"], "upriver").summary == "Goes upriver."


def test_a_class_beside_needs_its_hook_too(write):
    text = EVALUATION.replace("{module}", "evaluation_alone").replace("{table}", "SuiteSpec")
    without = BESIDE.replace("def roboneuron_boat_trips() ->", "def roboneuron_other() ->")
    without = without.partition("@hookimpl")[0]
    registry = discover(points=write(evaluation_alone=text + without))
    assert registry.plugins[0].status is Status.FAILED
    assert "roboneuron_boat_trips, which evaluation_alone lacks" in registry.plugins[0].reason


def test_without_the_feature_its_hook_is_unknown(write):
    text = "from roboneuron import hookimpl\n@hookimpl\ndef roboneuron_suites(): return []\n"
    registry = discover(points=write(a_suite_alone=text))
    assert registry.plugins[0].status is Status.FAILED
    assert "roboneuron_suites is no hook" in registry.plugins[0].reason


@pytest.mark.parametrize(
    ("table", "fault"),
    [
        ("MISSING", "there is no attribute 'MISSING'"),
        ("__name__", "expected a descriptor class"),
        ("BackendSpec", "there already"),
        ("BoatSpec", "roboneuron_boats, which evaluation_boatspec lacks"),
    ],
)
def test_a_feature_with_unusable_hooks_fails_alone(write, table, fault):
    feature = EVALUATION.replace("{module}", f"evaluation_{table.lower()}").replace(
        "{table}", table
    )
    feature += "\nfrom roboneuron import BackendSpec\nclass BoatSpec(Spec):\n    kind = 'boat'\n"
    other = SECTION.format(name="fine")
    registry = discover(points=write(**{f"evaluation_{table.lower()}": feature, "fine_one": other}))
    by_module = {p.module: p for p in registry.plugins}
    assert by_module[f"evaluation_{table.lower()}"].status is Status.FAILED
    assert fault in by_module[f"evaluation_{table.lower()}"].reason
    assert by_module["fine_one"].status is Status.READY


def test_two_owners_of_one_section_disable_both(write):
    registry = discover(
        points=write(
            first_owner=SECTION.format(name="one"), second_owner=SECTION.format(name="two")
        )
    )
    assert {p.status for p in registry.plugins} == {Status.CONFLICT}
    assert (
        "The section 'shared' is claimed by first_owner and by second_owner"
        in registry.plugins[0].reason
    )


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ('sections=("Bad Key",)', "The section 'Bad Key'"),
        ('sections=("a",), config=None', "has no `config`"),
        ('brings="nowhere"', "expected 'package.module:attribute'"),
    ],
)
def test_malformed_features_are_named(write, change, fault):
    name = f"malformed_{abs(hash(change))}"
    text = SECTION.format(name="x")
    field = 'sections=("shared",)'
    text = text.replace('config="m:C", ', "") if "config=None" in change else text
    registry = discover(points=write(**{name: text.replace(field, change)}))
    assert registry.plugins[0].status is Status.FAILED
    assert fault in registry.plugins[0].reason
