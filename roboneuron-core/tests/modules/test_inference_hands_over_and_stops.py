"""Inference that shares its robot with a successor or a fallback, and stops."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import pytest
from inference_cell import Cell
from loop_plugin import Windows

from rn_testing.waiting import holds_within
from roboneuron.estop.latch import EmergencyStopLatch

pytestmark = pytest.mark.ros
WITH_FALLBACK = {'instruction = "go"': 'instruction = "go"\nfallback = "instant"'}


def windows(cell: Cell) -> Windows:
    return next(one for one in cell.inference.filters if isinstance(one, Windows))


def test_in_shadow_it_predicts_and_reports_but_publishes_nothing(
    make_inference: Callable[..., Cell],
) -> None:
    cell = make_inference("instant")
    cell.set(act_from_ns=2**62)
    cell.send_image()
    assert holds_within(lambda: cell.status()["ready"] == "true")
    assert windows(cell).withheld[0].actions[0].tolist() == [0.01, 0, 0, 0, 0, 0, 1]
    assert not cell.actions
    assert not windows(cell).sent


def test_its_turn_begins_and_ends_with_the_capture_time_of_the_image(
    make_inference: Callable[..., Cell],
) -> None:
    cell = make_inference("instant")
    now_ns = cell.world.node.get_clock().now().nanoseconds
    cell.set(act_from_ns=now_ns, act_until_ns=now_ns + 300_000_000)
    cell.send_image(age_s=0.2)
    assert holds_within(lambda: cell.status().get("note") == "in shadow")
    assert not cell.actions
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 1)
    assert holds_within(
        lambda: cell.world.node.get_clock().now().nanoseconds > now_ns + 300_000_000
    )
    cell.send_image()
    assert holds_within(lambda: cell.status().get("note") == "handed over to the successor")
    assert len(cell.actions) == 1


def test_a_chunk_ends_when_the_successor_begins(make_inference: Callable[..., Cell]) -> None:
    cell = make_inference("chunked")
    cell.send_image()
    assert holds_within(lambda: len(cell.actions) == 2)
    cell.set(play_until_ns=1)
    assert not holds_within(lambda: len(cell.actions) > 3, 0.3)


def test_a_fallback_acts_while_the_policy_does_not_answer(
    make_inference: Callable[..., Cell], request: pytest.FixtureRequest
) -> None:
    cell = make_inference("moody", replace=WITH_FALLBACK)
    may_answer = cell.inference.module.backend.may_answer
    request.addfinalizer(may_answer.set)
    may_answer.set()

    def newest() -> float:
        cell.send_image()
        time.sleep(0.02)
        return float(cell.actions[-1].data[0]) if cell.actions else 0.0

    assert holds_within(lambda: newest() == 0.005)
    assert cell.status()["fallback.acting"] == "moody"
    may_answer.clear()
    assert holds_within(lambda: newest() == 0.01), "the fallback acts"
    assert cell.status()["fallback.acting"] == "instant"
    assert cell.status()["fallback.reason"].startswith("no answer within 0.")
    assert cell.status()["error_code"] == ""
    assert holds_within(lambda: "instant acts in place of moody" in cell.status()["note"])
    may_answer.set()
    assert holds_within(lambda: newest() == 0.005, 15.0), "the policy acts again"
    assert holds_within(lambda: cell.status()["fallback.acting"] == "moody")


def test_a_stop_outlives_a_change_of_policies(
    make_inference: Callable[..., Cell], request: pytest.FixtureRequest
) -> None:
    """An answer to an image from before the stop moves nothing, in any module."""
    cell = make_inference("moody", replace=WITH_FALLBACK)
    may_answer = cell.inference.module.backend.may_answer
    request.addfinalizer(may_answer.set)
    may_answer.clear()
    cell.send_image()
    cell.world.run(lambda: cell.inference.require_start("a test"))
    may_answer.set()
    for _ in range(20):
        cell.send_image()
        time.sleep(0.02)
    assert not cell.actions
    assert cell.instruct("go").successful
    assert holds_within(lambda: cell.send_image() and len(cell.actions) > 0)


def test_what_is_started_during_a_stop_proves_that_it_sees(
    world: Any, make_inference: Callable[..., Cell]
) -> None:
    """Otherwise a start would wait in vain for its first action, until its time limit."""
    EmergencyStopLatch.in_directory(world.state_directory).press(who="a test", reason="a test")
    cell = make_inference("instant")
    assert cell.status()["ready"] == "false"
    assert holds_within(lambda: cell.send_image() and cell.status()["ready"] == "true")
    assert not cell.actions
    assert not cell.instruct("go").successful
