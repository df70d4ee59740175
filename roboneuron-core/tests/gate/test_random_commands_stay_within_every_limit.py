"""Random actions, from rest and in motion, on a planar arm: no command exceeds a limit."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from planar import NAMES, SCALE, START, command, inspect, limiter, place, profile, sample

from roboneuron.contract import (
    JointCommand,
    Obstacle,
)
from roboneuron.gate.motion import MotionRules
from roboneuron.gate.motion.joint_space import JointLimit, braking_velocity

way = st.tuples(*[st.floats(-1.0, 1.0, allow_nan=False) for _ in NAMES])
steps = st.lists(
    st.tuples(way, st.floats(0.001, 0.4), st.floats(0.02, 0.3), st.floats(0.0, 1.0)),
    min_size=1,
    max_size=25,
)
RULES = MotionRules(
    reactions=SCALE,
    max_step_m=0.2,
    max_step_rad=0.4,
    max_speed_m_s=0.4,
    max_turn_rad_s=1.2,
    lower_m=np.array([0.1, -1.0, -0.2]),
    upper_m=np.array([0.9, 1.0, 0.9]),
    min_height_m=0.1,
    zones=(
        Obstacle(name="vase", lower_m=np.array([0.3, -1, 0.3]), upper_m=np.array([0.45, 1, 0.45])),
    ),
    min_singular_value=0.1,
)


@settings(max_examples=100, deadline=None)
@given(steps=steps, immediate=st.booleans(), braking=st.booleans())
def test_random_actions_never_produce_a_command_outside_any_limit(
    steps: list[tuple[tuple[float, float], float, float, float]], immediate: bool, braking: bool
) -> None:
    judge = limiter(RULES, immediate=immediate, braking=braking)
    limits = [JointLimit.by_joint(profile(braking=braking))[name] for name in NAMES]
    position, commanded, velocity = START.copy(), START.copy(), np.zeros(2)
    now_s, last_s = 10.0, -math.inf
    for asked, wait_s, duration_s, lag in steps:
        verdict = judge.limit(command(position + asked, duration_s), sample(position), now_s)
        if isinstance(verdict.command, JointCommand):
            target = verdict.command
            change, time_s = target.position - commanded, target.duration_s
            for i, limit in enumerate(limits):
                assert limit.lower - 1e-6 <= target.position[i] <= limit.upper + 1e-6
                bound = min(limit.fastest(commanded[i], change[i] > 0, time_s), limit.velocity)
                assert abs(change[i]) / time_s <= bound * (1 + 1e-5) + 1e-9
                assert (
                    abs(change[i] / time_s - velocity[i])
                    <= 4.0 * min(now_s - last_s, time_s) * (1 + 1e-5) + 1e-9
                )
            assert np.linalg.norm(place(target.position) - place(commanded)) / time_s <= 0.4 * (
                1 + 1e-6
            )
            tcp = place(target.position)
            assert (tcp >= RULES.lower_m - 1e-9).all()
            assert (tcp <= RULES.upper_m + 1e-9).all()
            assert tcp[2] >= 0.1 - 1e-9
            assert not ((tcp > [0.3, -1, 0.3]) & (tcp < [0.45, 1, 0.45])).all()
            assert inspect(sample(target.position)).smallest_singular_value >= 0.1 - 1e-9
            # The robot follows: it is where the command takes it in `wait_s`, or a little behind.
            part = 1.0 if immediate else min(1.0, wait_s / time_s)
            last_s = now_s
            velocity = change / time_s
            # after its end it brakes with 4 rad/s^2
            over_s = max(0.0, wait_s - (2 * time_s if immediate else time_s))
            velocity = np.sign(velocity) * np.maximum(0.0, np.abs(velocity) - 4.0 * over_s)
            behind = min(lag, 0.05 / max(1e-9, float(np.abs(change * part).max())))
            position, commanded = (
                commanded + change * part * (1 - behind),
                commanded + change * part,
            )
        else:
            judge.rest(sample(position), now_s)
            commanded, velocity, last_s = position.copy(), np.zeros(2), now_s
        now_s += wait_s


@settings(max_examples=100, deadline=None)
@given(way=way, duration_s=st.floats(0.02, 1.0))
def test_from_rest_every_shortened_command_keeps_the_direction(
    way: tuple[float, float], duration_s: float
) -> None:
    verdict = limiter(RULES).limit(command(START + way, duration_s), sample(START), 1.0)
    if not isinstance(verdict.command, JointCommand):
        return
    moved = verdict.command.position - START
    np.testing.assert_allclose(moved, verdict.share * np.array(way), atol=1e-9)


@given(
    distance=st.floats(0.0, 3.0),
    offset=st.floats(0.0, 0.5),
    deceleration=st.floats(0.5, 20.0),
    step=st.floats(0, 0.5),
)
def test_velocity_towards_a_limit_can_always_be_braked_before_it(
    distance: float, offset: float, deceleration: float, step: float
) -> None:
    velocity = braking_velocity(distance, offset, deceleration, step)
    left = distance - velocity * step
    assert left >= -1e-9
    assert (
        velocity == 0.0 or velocity <= -offset + math.sqrt(2 * deceleration * max(left, 0.0)) + 1e-6
    )
