"""Film strips of agents' episodes are drawn from the simulator's state."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
from PIL import Image

from rn_eval.agents.films import film_strip
from rn_robot_fr3.cell import FR3
from rn_robot_fr3.contract_cases import state_at_home
from rn_simulation.scene_state import SceneState, from_message


def states(count: int) -> list[SceneState]:
    """An arm that turns its first joint."""
    first = from_message(state_at_home(3, 1_000_000_000), {FR3.robot: len(FR3.joints)})
    found = []
    for number in range(count):
        joints = first.joints.copy()
        joints[0] = number * 0.05
        stamp_ns = first.stamp_ns + number * 500_000_000
        found.append(replace(first, joints=joints, stamp_ns=stamp_ns))
    return found


def opened(data: bytes) -> Image.Image:
    return Image.open(io.BytesIO(data)).convert("RGB")


def test_a_strip_shows_six_moments():
    strip = opened(film_strip(states(30), 0))
    assert strip.width == 6 * 160 + 5 * 3
    pixels = np.asarray(strip)[:160]
    first, last = pixels[:, :160], pixels[:, -160:]
    assert np.abs(first.astype(int) - last.astype(int)).max() > 100, "the arm has turned"


def test_few_states_give_a_short_strip_and_none_give_none():
    assert opened(film_strip(states(2), 0)).width == 2 * 160 + 3
    assert film_strip([], 0) == b""


def test_states_of_an_older_scene_are_left_out():
    old = [replace(state, cubes=(("purple", 0.04),)) for state in states(4)]
    assert opened(film_strip([*old, *states(1)], 0)).width == 160
