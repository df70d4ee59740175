"""Each task's judge accepts a correct episode, and rejects wrong ones."""

from __future__ import annotations

import math
from functools import partial
from typing import cast

import pytest
import staged_requests as requests
from agent_stage import Stage, said
from staged_episodes import (
    around,
    at_place,
    away_and_home,
    both,
    both_in_the_wrong_order,
    broken_off,
    carried_and_dropped,
    claimed_done,
    done_nevertheless,
    dropped,
    explained,
    explained_all,
    explained_but_moved,
    explained_nothing,
    fingers,
    held_and_looked,
    held_up,
    held_with_a_break,
    in_two_parts,
    looked,
    looked_wrongly,
    lowered,
    moved_a_cube,
    named,
    not_quite_at_place,
    picked,
    picked_another,
    pressed,
    put,
    put_and_pushed,
    put_beside_it,
    recorded,
    refused,
    refused_without_a_reason,
    shut_down,
    slow,
    slowly_picked,
    stacked,
    stacked_in_the_air,
    still_held,
    straight_through,
    taken_home,
    through_the_side,
    turned,
    turned_base,
    two_arms,
    waited,
    with_base,
)

from rn_eval.agents.contract_cases import nothing_seen
from rn_eval.agents.offers import TASKS
from rn_eval.agents.task import AgentTask
from rn_eval.agents.tasks.refuse import PERSON_M
from roboneuron.feature import build

PICKS = ((picked,), (picked_another, dropped))
PUTS = ((put,), (put_beside_it, still_held, put_and_pushed))
LOOKS = ((looked,), (looked_wrongly, moved_a_cube))


def case(act, *wrong, passing=({},)):
    """An episode that passes with these arguments, and fails with each of the others, or as another
    episode.
    """
    fails = [partial(act, **one) if isinstance(one, dict) else one for one in wrong]
    return tuple(partial(act, **one) for one in passing), tuple(fails)


RECOVERS = ((picked,), (picked_another, dropped))
EXPLAINS = ((explained,), (explained_nothing, explained_but_moved))
RECORDS = (
    (recorded,),
    (
        lambda scene: recorded(scene, files=()),
        lambda scene: recorded(scene, answer="/tmp/other.mcap"),
        lambda scene: recorded(scene, act=False),
    ),
)
CASES = {
    **{task.name: LOOKS for task in TASKS if task.family == "look"},
    "look-table": case(
        requests.looked_at_table, {"off_m": 0.03}, {"kind": "real"}, {"names": -1}, moved_a_cube
    ),
    "look-closely": case(
        requests.saw_the_wrist, {"answer_bytes": 200}, {"camera": "front"}, {"moves": True}
    ),
    "look-ahead": case(requests.told_ahead, {"off_cm": 4.0}, {"moves": True}),
    **{task.name: PICKS for task in TASKS if task.family == "pick"},
    "pick-turned": case(
        requests.raised, {"up_m": 0.02}, {"turn_deg": 20.0}, picked, dropped, picked_another
    ),
    "pick-stacked": case(
        requests.stacked_then_picked,
        {"stacks": False},
        {"share": 2.0},
        {"y_m": 0.2},
        {"lifts": False},
    ),
    "pick-hold-out": case(requests.held_out, {"off_m": 0.1}, dropped, picked_another),
    "pick-and-home": ((taken_home,), (picked, picked_another)),
    **{task.name: PUTS for task in TASKS if task.family == "place"},
    "put-taken": case(
        requests.put_gently, {"seconds": 1.0}, put_beside_it, still_held, put_and_pushed
    ),
    "put-yawed": case(requests.put_turned, {"off_deg": 20.0}, put_beside_it, still_held),
    "put-beside": case(
        requests.put_beside, {"more_m": 0.02}, {"more_m": -0.02}, {"flip": -1.0}, {"holds": True}
    ),
    "arrange-line": case(requests.lined_up, {"more_m": 0.03}, {"aside_m": 0.02}),
    "arrange-push": case(
        requests.pushed, {"share": 0.5}, {"share": 0.0}, {"rise": 0.05}, {"other": True}
    ),
    "arrange-swap": case(requests.swapped, {"off_m": 0.04}, {"only_one": True}),
    "arrange-tower": case(requests.towered, {"order": ("low", "top", "middle")}, {"off_m": 0.04}),
    "arrange-half": case(requests.cleared, {"all_of_them": False}, {"others": True}),
    "arrange-turn": case(requests.turned_in_place, {"turn_deg": 10.0}, {"off_m": 0.04}),
    "arrange-back": case(requests.put_and_back, {"goes": False}, {"returns": False}),
    "arrange-sizes": case(requests.sized, {"upper": "large", "lower": "small"}, {"off_m": 0.04}),
    "move-ready": case(requests.got_ready, {"running": ("robot", "control")}, {"moves": True}),
    "move-wave": case(requests.waved, {"times": 1}, {"touches": True}),
    "move-over": case(requests.over_it, {"off_m": 0.04}, {"touches": True}),
    "put-onto": ((stacked,), (stacked_in_the_air, picked_another)),
    "put-then-pick": (
        (both,),
        (both_in_the_wrong_order, lambda scene: both(scene, ("one",))),
    ),
    "move-by": ((at_place,), (not_quite_at_place,)),
    "move-to-place": ((at_place,), (not_quite_at_place,)),
    "move-and-home": (
        (away_and_home,),
        (
            lambda scene: away_and_home(scene, back=False),
            lambda scene: away_and_home(scene, depth=-0.05),
        ),
    ),
    "move-gripper": (
        (fingers,),
        (lambda scene: fingers(scene, off=30), lambda scene: fingers(scene, arm=True)),
    ),
    "move-joint": (
        (turned,),
        (lambda scene: turned(scene, off=5), lambda scene: turned(scene, arm=True)),
    ),
    "limits-slow": (
        (slow,),
        (lambda scene: slow(scene, 2.0), lambda scene: (Stage(scene).truth(), said())),
    ),
    "limits-slow-pick": ((slowly_picked,), (lambda scene: slowly_picked(scene, 2.0), dropped)),
    "limits-not-below": (
        (lowered,),
        (lambda scene: lowered(scene, -2.0), lambda scene: lowered(scene, 5.0)),
    ),
    "limits-half": ((picked,), (through_the_side, dropped)),
    "limits-box": ((around,), (straight_through, lambda scene: (Stage(scene).truth(), said()))),
    "stop-and-go-on": (
        (in_two_parts,),
        (lambda scene: in_two_parts(scene, 0.5), lambda scene: broken_off(scene)),
    ),
    "stop-break-off": (
        (broken_off,),
        (
            lambda scene: broken_off(scene, to=math.radians(-100)),
            lambda scene: broken_off(scene, to=math.radians(44)),
            lambda scene: broken_off(scene, latch=True),
        ),
    ),
    "stop-emergency": (
        (pressed,),
        (
            lambda scene: (Stage(scene).truth(), said()),
            lambda scene: pressed(scene, ("get_status",) * 4),
        ),
    ),
    "stop-person-releases": (
        (waited,),
        (
            lambda scene: waited(scene, early=True),
            lambda scene: waited(scene, asked=("reset_emergency_stop",)),
            lambda scene: (Stage(scene).stand(3.0).latch().truth(), said()),
        ),
    ),
    "stop-safe": case(
        requests.left_safe, {"lifts": False}, {"seconds": 0.3}, {"falls": True}, picked
    ),
    "stop-all": (
        (shut_down,),
        (
            lambda scene: shut_down(scene, wall_s=0.5),
            lambda scene: shut_down(scene, moved=True),
        ),
    ),
    **{task.name: RECOVERS for task in TASKS if task.family in ("recover", "again")},
    "recover-dropped-held": (
        (held_up, lambda scene: held_up(scene, falls=False)),
        (lambda scene: held_up(scene, short_s=4.0), held_with_a_break, dropped, picked_another),
    ),
    "recover-dropped-carried": ((put,), (carried_and_dropped, still_held, dropped)),
    "several-one": (
        (two_arms,),
        (
            lambda scene: two_arms(scene, lifts=()),
            lambda scene: two_arms(scene, wrong=True),
            lambda scene: two_arms(scene, moved=("other",)),
            lambda scene: two_arms(scene, lifts=("other",)),
        ),
    ),
    "several-both": (
        (lambda scene: two_arms(scene, lifts=("robot", "other")),),
        (two_arms, lambda scene: two_arms(scene, lifts=("robot", "other"), wrong=True)),
    ),
    "several-stop-one": (
        (lambda scene: two_arms(scene, latched=("other",)),),
        (
            two_arms,
            lambda scene: two_arms(scene, latched=("robot", "other")),
            lambda scene: two_arms(scene, latched=("other",), lifts=()),
            lambda scene: two_arms(scene, latched=("other",), moved=("other",)),
        ),
    ),
    "several-drive": (
        (with_base,),
        (
            lambda scene: with_base(scene, way_m=0.0),
            lambda scene: with_base(scene, turn_rad=0.3),
            lambda scene: with_base(scene, moves=True),
            lambda scene: with_base(scene, stops=False),
            picked,
        ),
    ),
    "several-turn": (
        (turned_base,),
        (
            lambda scene: turned_base(scene, 0.3),
            lambda scene: turned_base(scene, moves=True),
            with_base,
        ),
    ),
    "several-arm-and-base": (
        (lambda scene: with_base(scene, lifts=True),),
        (with_base, picked, lambda scene: with_base(scene, way_m=0.0, lifts=True)),
    ),
    **{task.name: EXPLAINS for task in TASKS if task.family == "explain"},
    "explain-speed": case(requests.told_the_speed, {"share": 1.5}, {"rises": False}),
    "explain-today": case(requests.told_today, {"swaps": True}, {"moves": True}),
    "explain-held": case(requests.held_and_told, {"names": False}, {"lifts": False}),
    "explain-last": ((explained,), (explained_all, explained_but_moved)),
    "explain-newest": ((explained,), (explained_all, explained_but_moved)),
    "explain-running": ((explained,), (explained_all, explained_nothing)),
    "text-sign-holding": (
        (held_and_looked,),
        (
            lambda scene: held_and_looked(scene, calls=()),
            lambda scene: held_and_looked(scene, latch=True),
            dropped,
            picked_another,
        ),
    ),
    "text-sign-looking": (
        (named,),
        (
            lambda scene: named(scene, calls=()),
            lambda scene: named(scene, colours=scene.colours[:-1]),
            lambda scene: named(scene, moved=True),
            lambda scene: (Stage(scene).latch().truth(), named(scene)[1]),
        ),
    ),
    "text-label": case(
        picked, picked_another, dropped, lambda scene: held_and_looked(scene, latch=True)
    ),
    "text-note": (
        (lambda scene: (nothing_seen(), said(answer="1")),),
        (
            lambda scene: (nothing_seen(), said(answer="7")),
            lambda scene: (Stage(scene).truth(), said(answer="1")),
        ),
    ),
    "text-reason": (
        (lambda scene: (nothing_seen(), said(answer="yes")),),
        (
            lambda scene: (nothing_seen(), said(answer="no")),
            lambda scene: (nothing_seen(), said(answer="yes", calls=("reset_emergency_stop",))),
        ),
    ),
    "clients-wait": (
        (picked,),
        (lambda scene: (picked(scene)[0], said(calls=("take_over",))), dropped),
    ),
    "clients-take-over": (
        (lambda scene: (picked(scene)[0], said(calls=("take_over",))),),
        (picked, lambda scene: (dropped(scene)[0], said(calls=("take_over",)))),
    ),
    "record-move": RECORDS,
    "record-pick": RECORDS,
}
REFUSALS = ((refused,), (refused_without_a_reason, done_nevertheless, claimed_done))


TRIALS = [(spec, *(REFUSALS if spec.family == "refuse" else CASES[spec.name])) for spec in TASKS]


@pytest.mark.parametrize(("spec", "passing", "failing"), TRIALS, ids=[spec.name for spec in TASKS])
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.exhaustive) for seed in (1, 2))]
)
def test_a_judge_passes_and_fails(spec, passing, failing, seed):
    task = cast(AgentTask, build(spec, {}))
    scene = task.prepare(seed)
    more = (spec.name,) if spec.family == "refuse" else ()
    for act in passing:
        verdict = task.judge(scene, *act(scene, *more))
        assert verdict.success, verdict.reason
    for act in failing:
        verdict = task.judge(scene, *act(scene, *more))
        assert not verdict.success, act
        assert verdict.reason.endswith(".")


def test_the_zone_lies_beside_home():
    lower, upper = PERSON_M
    assert lower[1] > 0.1
    assert upper[1] > lower[1]
