"""Rules of controllers on memory: what was computed before, and the time, change no answer."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from rn_testing.cases import ControllerCase
from rn_testing.commands import home_sample, make_action, postures
from rn_testing.rule import Rule, require
from rn_testing.rules.clock import later, ros_clock
from rn_testing.rules.controller import STEP_S, compute, controller_rule, loaded
from rn_testing.snapshots import snapshot
from roboneuron import JointCommand

MOST_BETWEEN, BETWEEN_S = 400, 2.0
"""Computations between two of the same action: at most, and the time after which no more follow
[s].
"""


def _check_memoryless(case: ControllerCase) -> None:
    joints = home_sample(case.robot())
    action = make_action(0.003, -0.002, 0.001)
    results: list[Any] = []
    for _ in range(2):
        with loaded(case) as controller:
            results.append(compute(controller, action, joints))
            compute(controller, make_action(5.0), joints)
            begun_s = time.monotonic()
            for _ in range(MOST_BETWEEN):
                controller.compute(make_action(-0.004, 0.001, 0.002), joints, STEP_S)
                if time.monotonic() - begun_s > BETWEEN_S:
                    break
            results.append(compute(controller, action, joints))
            with later():
                results.append(compute(controller, action, joints))
            for stamp_ns in (10_000_000_000, time.time_ns(), ros_clock()):
                results.append(compute(controller, action, replace(joints, stamp_ns=stamp_ns)))
    first = results[0]
    for again in results[1:]:
        require(type(first) is type(again), "the same input led to a command once and to Hold once")
        if isinstance(first, JointCommand):
            require(first.names == again.names, "the same input led to commands of other joints")
            drift = float(np.abs(first.position - again.position).max())
            require(drift <= 1e-9, f"the same input led to commands that differ by {drift:g}")


def _check_answers_kept(case: ControllerCase) -> None:
    first, *others = postures(case.robot())
    with loaded(case) as controller:
        answers = (
            compute(controller, make_action(0.003), first),
            controller.forward(first),
        )
        before = snapshot(answers)
        for joints in others:
            compute(controller, make_action(-0.002, 0.001), joints)
            controller.forward(joints)
    require(snapshot(answers) == before, "a command or pose changes when the next one is computed")


RULES: tuple[Rule[ControllerCase], ...] = (
    controller_rule(
        "memoryless",
        "The same action and joints yield the same command, from any instance, whatever was "
        "computed before and whatever the time; the input is not changed.",
        _check_memoryless,
    ),
    controller_rule(
        "answers-kept",
        "A returned command or pose is not changed later.",
        _check_answers_kept,
    ),
)
"""Rules of controllers on memory."""
