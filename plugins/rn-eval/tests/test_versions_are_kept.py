"""A ledger stores the versions of each episode, and mixes them only on request."""

from __future__ import annotations

import io
import json
import platform
import re
from importlib.metadata import version
from pathlib import Path

import pytest
from rich.console import Console

from rn_eval.evaluate import evaluate
from rn_eval.ledger import FILE_NAME, Ledger, read_plan, read_records
from rn_eval.plan import EvalPlan, Key
from rn_eval.pools import InProcess
from rn_eval.record import EpisodeOutcome, EpisodeRecord, MachineFacts
from rn_eval.report import load
from rn_eval.versions import changed_versions, installed_versions
from roboneuron import ConfigurationError
from roboneuron.config import load_config
from roboneuron.plugins.discovery import discover

PAGE = Path(__file__).parents[3] / "docs" / "evaluation.md"
OLDER = {"roboneuron-core": "0.1", "rn-eval": "0.1", "python": platform.python_version()}
QUIET = Console(file=io.StringIO())


def test_versions_are_those_of_all_that_the_outcome_depends_on():
    plan = EvalPlan(
        suite="cubes",
        backend="oft-primary",
        presets=("none", "fastv-p50"),
        episodes=1,
        config=load_config(None).model_dump(mode="json"),
    )
    found = installed_versions(plan, discover())
    assert found["python"] == platform.python_version()
    own = {
        "roboneuron-core",
        "rn-eval",
        "rn-standard",
        "rn-simulation",
        "rn-robot-fr3",
        "rn-controller-urdf",
    }
    model = {"rn-backend-oft", "rn-runtime-torch", "rn-accel-fastv", "rn-vla", "torch", "numpy"}
    assert own | model <= set(found)
    assert {"pybullet", "mujoco"} & set(found)
    assert found["torch"] == version("torch")
    assert "rn-view" not in found


def test_each_line_and_the_plan_have_the_versions(plan, tmp_path):
    made = plan(episodes=1)
    made = made.model_copy(update={"versions": installed_versions(made, discover())})
    evaluate(made, tmp_path, lambda: InProcess(made), QUIET)
    line = json.loads((tmp_path / FILE_NAME).read_text())
    assert line["versions"] == read_plan(tmp_path).versions
    assert line["versions"]["roboneuron-core"] == version("roboneuron-core")


def test_a_run_goes_on_under_other_versions_only_when_told_to(plan, tmp_path):
    begun = plan(episodes=1, versions=OLDER)
    with Ledger(tmp_path) as ledger:
        ledger.open(begun)
    now = plan(episodes=1)
    now = now.model_copy(update={"versions": installed_versions(now, discover())})
    with pytest.raises(
        ConfigurationError, match=r"begun under other versions: roboneuron-core 0\.1 ->"
    ) as refusal:
        evaluate(now, tmp_path, lambda: InProcess(now), QUIET)
    assert "--other-versions" in refusal.value.hint
    assert read_plan(tmp_path) == begun
    evaluate(now, tmp_path, lambda: InProcess(now), QUIET, other_versions=True)
    kept = read_plan(tmp_path)
    assert {name: kept.versions[name] for name in OLDER} == OLDER
    assert kept.later_versions == (now.versions,)
    assert read_records(tmp_path)[0].versions == now.versions
    about = dict(load([tmp_path])[1])
    assert f"rn-eval 0.1 and {version('rn-eval')}" in about["versions"]


def test_a_worker_of_other_versions_is_refused(plan, tmp_path):
    key = Key(suite="toy", preset="none", execution="sequential", latency="0", task="t", seed=0)
    foreign = EpisodeRecord(
        key=key,
        instruction="reach",
        outcome=EpisodeOutcome(status="success"),
        host="far",
        versions=OLDER,
    )
    with Ledger(tmp_path) as ledger:
        ledger.open(plan(versions={"rn-eval": "0.2"}))
        with pytest.raises(
            ConfigurationError, match=r"worker on far has other versions .*rn-eval 0\.2 -> 0\.1"
        ):
            ledger.add(foreign)
    assert read_records(tmp_path) == []


def test_only_what_both_name_is_compared():
    """More presets use more packages; old ledgers name fewer."""
    assert changed_versions({"a": "1", "b": "1"}, {"a": "2", "c": "1"}) == ["a 1 -> 2"]


def test_the_page_names_every_field_of_a_line():
    text = PAGE.read_text(encoding="utf-8")
    named = set(re.findall(r"`([a-z0-9_.]+)`", text))
    fields = {
        name for name in EpisodeRecord.model_fields if name not in ("key", "outcome", "measured")
    }
    for part, model in (("key", Key), ("outcome", EpisodeOutcome), ("measured", MachineFacts)):
        fields |= {f"{part}.{name}" for name in model.model_fields}
    assert fields - named == set()
