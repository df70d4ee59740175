"""The kit detects mistakes: each mutant of a good plugin fails the rule for its mistake."""

from __future__ import annotations

import atexit
import logging
import os
import tempfile
from collections import Counter, defaultdict
from dataclasses import replace
from functools import cache
from typing import Any

import mutants_backend
import mutants_continuing
import mutants_controller_inputs
import mutants_controller_rows
import mutants_controllers
import mutants_descriptors
import mutants_devices
import mutants_driver_states
import mutants_drivers
import mutants_engines
import mutants_further
import mutants_models
import mutants_processes
import mutants_profiles
import mutants_settings
import mutants_sources
import mutants_spaces
import pytest
from mutation import Mutant

from rn_testing import (
    AccelerationCase,
    BackendCase,
    Case,
    ControllerCase,
    PerceptionCase,
    RobotCase,
    RuleResult,
    RuleVerdict,
    RuntimeCase,
    effects,
    fakes,
    lifecycle,
    verify,
)
from rn_testing.rules import RULES
from roboneuron.plugins.specs import RobotSpec, Spec

GOOD: dict[str, Case[Any]] = {
    "backend": BackendCase(spec=fakes.FAKE_BACKEND),
    "runtime": RuntimeCase(
        spec=fakes.FAKE_RUNTIME,
        model=lambda: "model",
        request=lambda: "one two three four",
        bad_request=lambda: 3,
        other_request=lambda: "one two",
        expected=lambda: 4,
        acceleration=lambda: fakes.HalvingAcceleration(None),
    ),
    "acceleration": AccelerationCase(
        spec=fakes.FAKE_ACCELERATION,
        decoder=fakes.FakeDecoder,
        expected=lambda decoder: decoder.kept_fraction == 0.5,
    ),
    "perception": PerceptionCase(
        spec=fakes.FAKE_PERCEPTION,
        feed=lambda source, topics: source.show("front"),
        timeout_s=1.0,
        expected=fakes.gradient_image,
    ),
    "controller": ControllerCase(spec=fakes.FAKE_CONTROLLER),
    "robot": RobotCase(spec=fakes.FAKE_ROBOT, settle_s=1.0),
}
QUICK_S = 0.3
"""Limit of a mutant's constructor [s]; lower, so that a sleeping one need not sleep for a
second.
"""
SLOW = {
    "backend:constructor_computes",
    "backend:every_image_is_copied_and_kept",
    "backend:every_image_is_kept",
    "controllers:constructor_computes",
    "controllers:every_action_is_kept",
    "devices:driver_hold_creeps_home",
    "devices:driver_hold_creeps_home_slowly",
    "devices:driver_hold_sags",
    "devices:driver_hold_shuts_the_gripper",
    "devices:driver_state_of_a_second_ago",
    "devices:driver_velocity_in_degrees",
    "devices:source_faster_than_its_case_says",
    "devices:source_read_waits_half_a_second",
    "drivers:driver_constructor_computes",
    "drivers:driver_gripper_inverted",
    "drivers:driver_hold_coasts_on",
    "drivers:driver_hold_does_nothing",
    "drivers:driver_hold_drives_home",
    "drivers:driver_hold_jumps_to_the_goal",
    "drivers:driver_jumps_whatever_the_duration",
    "drivers:driver_send_moves_by_the_position",
    "drivers:driver_stamp_stays",
    "engines:acceleration_constructor_computes",
    "engines:runtime_abort_hangs",
    "engines:runtime_constructor_computes",
    "processes:backend_constructor_sleeps",
    "processes:controller_constructor_sleeps",
    "processes:driver_constructor_sleeps",
    "processes:perception_constructor_sleeps",
    "processes:runtime_constructor_sleeps",
    "sources:constructor_computes",
    "sources:read_hangs",
    "sources:read_ignores_its_timeout",
    "sources:read_waits_a_second_longer",
    "sources:read_waits_whole_seconds",
}
"""Slow mutants (about a second or more); each of their rules also has a quicker one."""
PATIENT = {"constructor": 60.0}
"""Limits that let a computing mutant finish on a busy machine too [s]."""
KINDS = {"driver": "robot", "descriptor": "backend"}
"""Kind of rules whose ids have another prefix."""
MODULES = (
    mutants_backend,
    mutants_continuing,
    mutants_controller_inputs,
    mutants_controller_rows,
    mutants_controllers,
    mutants_descriptors,
    mutants_devices,
    mutants_driver_states,
    mutants_drivers,
    mutants_engines,
    mutants_further,
    mutants_models,
    mutants_processes,
    mutants_profiles,
    mutants_settings,
    mutants_sources,
    mutants_spaces,
)
MUTANTS: dict[str, Mutant] = {
    f"{module.__name__.removeprefix('mutants_')}:{name}": mutant
    for module in MODULES
    for name, mutant in module.MUTANTS.items()
}


def kind_of(rule_id: str) -> str:
    """The plugin kind of a rule."""
    subject = rule_id.partition("/")[0]
    return KINDS.get(subject, subject)


def make_case(name: str) -> Case[Any]:
    """The good case with the mutant instead of the good plugin."""
    mutant = MUTANTS[name]
    module, _, attribute = name.partition(":")
    target = {} if mutant.target is None else {"target": f"mutants_{module}:{attribute}"}
    good = GOOD[kind_of(mutant.rule)]
    # a hanging mutant has its own limit
    case = replace(good, limits_s={**PATIENT, **good.limits_s})
    spec: Spec = case.spec
    if mutant.rule.startswith("driver/") and isinstance(spec, RobotSpec):
        changes = {
            key: value for key, value in {**target, **mutant.spec}.items() if key != "drivers"
        }
        drivers = mutant.spec.get("drivers", (replace(spec.drivers[0], **changes),))
        return replace(case, spec=replace(spec, drivers=drivers), **mutant.case)
    return replace(case, spec=replace(spec, **target, **mutant.spec), **mutant.case)


@cache
def outcome_of_the_good(rule_id: str) -> RuleResult:
    kind = kind_of(rule_id)
    return verify(next(rule for rule in RULES[kind] if rule.id == rule_id), GOOD[kind])


@pytest.fixture(autouse=True)
def _what_mutants_leave(tmp_path, monkeypatch):
    """Put files of mutants into the test's folders, and close what they left open."""
    for name in ("here", "temporary"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    yield
    while mutants_processes.LEFT:
        os.close(mutants_processes.LEFT.pop())
    atexit.unregister(int)


@pytest.mark.sampled(every=10)
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in MUTANTS],
)
def test_a_mutant_fails_the_rule_for_its_mistake(name, monkeypatch):
    mutant = MUTANTS[name]
    good = outcome_of_the_good(mutant.rule)
    assert good.verdict is not RuleVerdict.FAILED, good
    monkeypatch.setattr(effects, "RELEASE_S", 0.3)  # what a mutant leaves running stays for seconds
    monkeypatch.setattr(lifecycle, "CONSTRUCTOR_S", QUICK_S)
    rule = next(rule for rule in RULES[kind_of(mutant.rule)] if rule.id == mutant.rule)
    outcome = verify(rule, make_case(name))
    assert outcome.verdict is RuleVerdict.FAILED, outcome
    assert mutant.words in outcome.detail, outcome
    assert outcome.detail


def test_warnings_that_were_logged_before_hide_no_plugin_that_logs_them(monkeypatch):
    logging.captureWarnings(True)
    try:
        test_a_mutant_fails_the_rule_for_its_mistake(
            "settings:backend_captures_warnings", monkeypatch
        )
    finally:
        logging.captureWarnings(False)


@pytest.mark.parametrize(
    ("declared", "rule"),
    [
        ("conditions_on_rows", "rows-kept"),
        ("conditions_on_rows", "ahead-optional"),
        ("takes_predicted_state", "predicted-state-used"),
    ],
)
def test_a_backend_that_continues_rows_passes_what_its_mutants_fail(declared, rule):
    spec = replace(
        fakes.FAKE_BACKEND, target="mutants_continuing:ContinuingBackend", **{declared: True}
    )
    case = BackendCase(spec=spec, row_tolerance=1e-6)
    outcome = verify(
        next(found for found in RULES["backend"] if found.id == f"backend/{rule}"), case
    )
    assert outcome.verdict is RuleVerdict.PASSED, outcome


def test_a_backend_of_joint_velocities_passes_what_its_mutants_fail():
    spec = replace(
        fakes.FAKE_BACKEND,
        target="mutants_spaces:VelocityBackend",
        space="mutants_spaces:velocities",
    )
    outcomes = {rule.id: verify(rule, BackendCase(spec=spec)) for rule in RULES["backend"]}
    failed = [one for one in outcomes.values() if one.verdict is RuleVerdict.FAILED]
    # it derives from the kit's fake, whose options it does not read
    assert {one.rule for one in failed} <= {"backend/options-read"}
    for name in ("space-answers", "space-light", "space-kept"):
        assert outcomes[f"backend/{name}"].verdict is RuleVerdict.PASSED
    assert outcomes["backend/units"].detail == "its chunks are in joint_velocity"


def test_every_rule_of_a_kind_has_a_mutant_that_breaks_it_quickly():
    rules = {rule.id for kind, rules in RULES.items() if kind in GOOD for rule in rules}
    assert {mutant.rule for name, mutant in MUTANTS.items() if name not in SLOW} == rules
    assert set(MUTANTS) >= SLOW


def test_each_kind_has_many_mutants():
    counts = Counter(kind_of(mutant.rule) for mutant in MUTANTS.values())
    assert sum(counts.values()) >= 400  # each is detected, or its own test above fails
    assert min(counts.values()) >= 20


def test_rules_have_unique_ids_a_text_and_a_source():
    seen: defaultdict[str, set[str]] = defaultdict(set)
    for rules in RULES.values():
        assert len({rule.id for rule in rules}) == len(rules)
        for rule in rules:
            seen[rule.id].add(rule.text)
            assert rule.text.endswith(".")
            assert rule.source
    assert all(len(texts) == 1 for texts in seen.values())
