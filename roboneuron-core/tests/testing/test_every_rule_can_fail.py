"""For each rule there is a plugin that breaks it, and the good one that it was made from keeps it."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from roboneuron.plugins.specs import DriverSpec, Spec
from roboneuron.testing import (
    AccelerationCase,
    BackendCase,
    Case,
    ControllerCase,
    PerceptionCase,
    RobotCase,
    RuntimeCase,
    Verdict,
    fakes,
    verify,
)
from roboneuron.testing.rules import RULES

GOOD: dict[str, Case[Any]] = {
    "backend": BackendCase(spec=fakes.FAKE_BACKEND),
    "runtime": RuntimeCase(
        spec=fakes.FAKE_RUNTIME,
        model=lambda: "model",
        request=lambda: "one two three four",
        bad_request=lambda: 3,
        acceleration=lambda: fakes.HalvingAcceleration(None),
    ),
    "acceleration": AccelerationCase(spec=fakes.FAKE_ACCELERATION, decoder=fakes.FakeDecoder),
    "perception": PerceptionCase(
        spec=fakes.FAKE_PERCEPTION, feed=lambda source, topics: source.show("front"), timeout_s=1.0
    ),
    "controller": ControllerCase(spec=fakes.FAKE_CONTROLLER),
    "robot": RobotCase(spec=fakes.FAKE_ROBOT, settle_s=1.0),
}


def _with(kind: str, **changes: object) -> Case[Any]:
    """The good case with its descriptor changed."""
    case = GOOD[kind]
    spec: Spec = replace(case.spec, **changes)
    return replace(case, spec=spec)


def _driver(target: str, module: str = "broken_robots") -> Case[Any]:
    driver = DriverSpec(name="simulated", summary="Broken.", target=f"{module}:{target}")
    return _with("robot", drivers=(driver,))


def _targets(kind: str, module: str, faults: dict[str, str]) -> list[tuple[str, Case[Any]]]:
    return [(rule, _with(kind, target=f"{module}:{name}")) for name, rule in faults.items()]


BROKEN: list[tuple[str, Case[Any]]] = [
    ("descriptor/well-formed", _with("backend", name="Not A Name")),
    ("descriptor/well-formed", _with("backend", cameras=["primary"])),
    ("descriptor/compatible", _with("backend", contract=99)),
    ("descriptor/summary-fits", _with("backend", summary="long " * 40)),
    ("descriptor/target-callable", _with("backend", target="broken_descriptors:not_callable")),
    ("descriptor/target-callable", _with("backend", target="broken_descriptors:WrongArguments")),
    ("descriptor/target-callable", _with("backend", target="broken_descriptors:Absent")),
    ("descriptor/options-closed", _with("backend", config="broken_descriptors:OpenOptions")),
    ("descriptor/options-described", _with("backend", config="broken_descriptors:BareOptions")),
    ("descriptor/restricted-options-marked", _with("backend", config="broken_descriptors:UnmarkedOptions")),
    ("descriptor/restricted-options-marked", _with("backend", config="broken_descriptors:UnmarkedTable")),
    *_targets(
        "backend",
        "broken_backends",
        {
            "NoReset": "backend/protocol",
            "OpensFile": "backend/constructor-pure",
            "StartsThread": "backend/constructor-pure",
            "Computes": "backend/constructor-pure",
            "CloseNeedsLoad": "backend/close-before-load",
            "TooLong": "backend/predict-within-horizon",
            "ReturnsArray": "backend/predict-within-horizon",
            "UsesUndeclared": "backend/predict-within-horizon",
            "TextMetrics": "backend/metrics-numeric",
            "ResetBreaks": "backend/reset-safe",
            "LeavesThread": "backend/close-releases",
            "PredictsUnloaded": "backend/predict-before-load-refused",
            "PredictsClosed": "backend/predict-after-close-refused",
            "Crashes": "backend/missing-frame-refused",
            "Blind": "backend/missing-frame-refused",
            "PaintsInput": "backend/images-kept",
        },
    ),
    ("backend/missing-state-refused", _with("backend", target="broken_backends:Blind")),
    ("backend/nan-state-refused", _with("backend", target="broken_backends:Blind")),
    ("runtime/families-declared", _with("runtime", families=())),
    ("runtime/run-after-close-refused", _with("runtime", target="broken_engines:NeverCloses")),
    *_targets(
        "runtime",
        "broken_engines",
        {
            "NoAbort": "runtime/protocol",
            "OpensFile": "runtime/constructor-pure",
            "CloseNeedsLoad": "runtime/close-before-load",
            "AnswersNothing": "runtime/run-answers",
            "RunsAlways": "runtime/run-before-load-refused",
            "RefusesAcceleration": "runtime/acceleration-accepted",
            "AbortHangs": "runtime/abort-harmless",
            "LeavesThread": "runtime/close-releases",
        },
    ),
    ("runtime/bad-request-refused", _with("runtime", target="broken_engines:RunsAlways")),
    ("acceleration/needs-declared", _with("acceleration", capability="")),
    *_targets(
        "acceleration",
        "broken_engines",
        {
            "NoApply": "acceleration/protocol",
            "PresetOpensFile": "acceleration/constructor-pure",
            "ApplyFails": "acceleration/applies",
            "AppliesOnce": "acceleration/applies-again",
            "AppliesToAnything": "acceleration/foreign-decoder-refused",
        },
    ),
    *_targets(
        "perception",
        "broken_sources",
        {
            "NoRead": "perception/protocol",
            "OpensFile": "perception/constructor-pure",
            "SubscribesEarly": "perception/constructor-leaves-topics",
            "CloseNeedsOpen": "perception/close-before-open",
            "WrongCamera": "perception/frame-of-a-camera",
            "NoFrameId": "perception/frame-of-a-camera",
            "NoStamp": "perception/frame-of-a-camera",
            "GoesBack": "perception/frames-in-order",
            "OneBuffer": "perception/frames-own-memory",
            "WaitsLong": "perception/read-bounded",
            "ReadsUnopened": "perception/read-before-open-refused",
            "ReadsClosed": "perception/read-after-close-refused",
            "LeavesThread": "perception/close-releases",
        },
    ),
    *_targets(
        "controller",
        "broken_controllers",
        {
            "NoForward": "controller/protocol",
            "OpensFile": "controller/constructor-pure",
            "CloseNeedsLoad": "controller/close-before-load",
            "LeavesThread": "controller/close-releases",
            "ComputesUnloaded": "controller/compute-before-load-refused",
            "LongQuaternion": "controller/forward-is-a-pose",
            "ForwardAccepts": "controller/forward-refuses-bad-joints",
            "StopsShort": "controller/small-steps-arrive",
            "RefusesAll": "controller/small-steps-arrive",
            "Drifts": "controller/zero-stands-still",
            "MovesBlindly": "controller/bad-numbers-hold",
            "HoldsSilently": "controller/bad-numbers-hold",
            "Jumps": "controller/far-targets-harmless",
            "LeavesLimits": "controller/far-targets-harmless",
            "Remembers": "controller/memoryless",
        },
    ),
    *_targets(
        "robot",
        "broken_robots",
        {
            "no_profile": "robot/profile-named",
            "other_name": "robot/profile-named",
            "crossed_limits": "robot/limits-sane",
            "short_limits": "robot/limits-sane",
            "far_home": "robot/home-inside",
            "torn_urdf": "robot/urdf-complete",
            "wrong_tcp": "robot/urdf-complete",
            "stray_joint": "robot/urdf-complete",
            "one_camera": "robot/cameras-agree",
            "stuck_gripper": "robot/gripper-travels",
            "empty_workspace": "robot/workspace-not-empty",
            "wrong_endpoint": "robot/endpoints-usable",
        },
    ),
    ("driver/target-callable", _driver("Absent")),
    ("driver/protocol", _driver("NoHold")),
    ("driver/constructor-pure", _driver("OpensFile")),
    ("driver/close-before-open", _driver("CloseNeedsOpen")),
    ("driver/reads-state", _driver("LacksJoint")),
    ("driver/reads-state", _driver("NeverReads")),
    ("driver/read-quick", _driver("ReadsSlowly")),
    ("driver/read-before-open-refused", _driver("ReadsUnopened")),
    ("driver/send-arrives", _driver("StaysPut")),
    ("driver/bad-command-refused", _driver("TakesAnything")),
    ("driver/limits-kept", _driver("ExceedsLimits")),
    ("driver/hold-stops", _driver("CoastsOn")),
    ("driver/close-releases", _driver("LeavesThread")),
]


def _label(item: tuple[str, Case[Any]]) -> str:
    rule, case = item
    target = case.spec.drivers[0].target if rule.startswith("driver/") else case.spec.target
    return f"{rule}:{target.rpartition(':')[2]}"


@cache
def _outcome_of_the_good(kind: str, rule_id: str) -> Verdict:
    rule = next(r for r in RULES[kind] if r.id == rule_id)
    return verify(rule, GOOD[kind]).verdict


@pytest.mark.parametrize("broken", BROKEN, ids=_label)
def test_a_broken_plugin_fails_its_rule_and_the_good_one_passes(broken):
    rule_id, case = broken
    kind = case.spec.kind
    rule = next(r for r in RULES[kind] if r.id == rule_id)
    outcome = verify(rule, case)
    assert outcome.verdict is Verdict.FAILED, outcome
    assert outcome.detail
    assert _outcome_of_the_good(kind, rule_id) is Verdict.PASSED


def test_every_rule_of_a_kind_has_a_plugin_that_breaks_it():
    broken = {rule for rule, _ in BROKEN}
    rules = {rule.id for kind, rules in RULES.items() if kind in GOOD for rule in rules}
    assert broken == rules


def test_rules_have_unique_ids_a_text_and_a_source():
    seen: defaultdict[str, set[str]] = defaultdict(set)
    for rules in RULES.values():
        for rule in rules:
            seen[rule.id].add(rule.text)
            assert rule.text.endswith(".")
            assert rule.source
    assert all(len(texts) == 1 for texts in seen.values())
