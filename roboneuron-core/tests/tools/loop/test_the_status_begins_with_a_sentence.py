"""get_status begins with a sentence: which robot, what moves it, why it does not move."""

from __future__ import annotations

import os
from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import pytest

from roboneuron import Host
from roboneuron.gate import StillReason
from roboneuron.tools.loop.results import StatusResult
from roboneuron.tools.loop.status import summary

LATCHED = StillReason(rank="stop", rule="emergency_stop", message="It is latched.")
TAKEN = StillReason(rank="claim", rule="ownership", message="A policy moves it.")


def told(
    running: tuple[str, ...] = ("robot",),
    motions: tuple[str, ...] = (),
    *reasons: StillReason,
    faults: tuple[int, list[str], float] = (0, [], 0.0),
) -> str:
    views = [SimpleNamespace(kind=kind, phase="running") for kind in running]
    loop = SimpleNamespace(
        robot_facts=SimpleNamespace(kind="simulated", name="FR3"),
        modules=SimpleNamespace(views=lambda: views),
    )
    counting = SimpleNamespace(recent_faults=lambda within_s: faults)
    features = SimpleNamespace(loaded={"ops": counting, "other": object()})
    return summary(
        cast(Host, SimpleNamespace(loop=loop, motions=motions, features=features)), reasons
    )


@pytest.mark.parametrize(
    ("made", "expected"),
    [
        (lambda: told(()), "nothing is started."),
        (lambda: told(), "robot started; nothing moves it."),
        (lambda: told(("robot", "control")), "robot, control started; nothing moves it."),
        (lambda: told(("robot",), ("move_ee of 'fr3'",)), "moved by move_ee of 'fr3'."),
        (
            lambda: told(faults=(6, ["robot", "control"], 4.2)),
            "6 interruptions of robot, control in the last 5 minutes, the newest 4 s ago.",
        ),
        (lambda: told(("robot",), (), LATCHED, TAKEN), "nothing moves it. It is latched."),
        (lambda: told(("robot",), ("a policy",), TAKEN), "moved by a policy."),
    ],
)
def test_the_sentence_tells_what_matters(
    monkeypatch: pytest.MonkeyPatch, made: Callable[[], str], expected: str
) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    sentence = made()
    assert sentence.startswith("Simulated robot FR3: ")
    assert sentence.endswith(expected)


@pytest.mark.parametrize(("load", "is_told"), [(20.0, True), (1.0, False)])
def test_an_overloaded_computer_is_the_cause_of_interruptions(
    monkeypatch: pytest.MonkeyPatch, load: float, is_told: bool
) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (load, load, load))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    sentence = told(faults=(1, ["robot"], 4.0))
    assert ("load 20 on 2 cores" in sentence) is is_told
    assert "overloaded" not in told()


def test_it_is_the_first_field() -> None:
    assert next(iter(StatusResult.model_fields)) == "summary"
