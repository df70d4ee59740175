"""Film strips of episodes, rendered from the simulator's state; they need no camera module."""

from __future__ import annotations

from collections.abc import Sequence

from rn_eval.film import FilmStrip
from rn_robot_fr3.cameras import cell_cameras
from rn_robot_fr3.cell import FR3
from rn_robot_fr3.world import build_world
from rn_simulation.cubes import Cube
from rn_simulation.scene_state import SceneState

_FRAMES = 6
_SIZE_PX = (224, 224)


def film_strip(states: Sequence[SceneState], begun_ns: int) -> bytes:
    """PNG with six frames of an episode from the front camera's view; b"" without states.

    Args:
        states: states of one simulated FR3, oldest first.
        begun_ns: start of the agent, ROS time [ns]; the zero of the captions.
    """
    if not states:
        return b""
    states = [state for state in states if state.cubes == states[-1].cubes]
    count = min(_FRAMES, len(states))
    chosen = [states[round(i * (len(states) - 1) / max(1, count - 1))] for i in range(count)]
    cubes = [Cube(name=n, edge_m=e, x_m=0.0, y_m=0.0, yaw_rad=0.0) for n, e in states[-1].cubes]
    front = cell_cameras(FR3)[0].calibration(*_SIZE_PX)
    film = FilmStrip()
    world = build_world(states[-1].engine, cubes)
    try:
        for state in chosen:
            world.set_joints(state.joints.tolist())
            poses = zip(state.cubes, state.cube_poses.tolist(), strict=True)
            world.set_cubes({name: (pose[:3], pose[3:]) for (name, _), pose in poses})
            at_s = (state.stamp_ns - begun_ns) / 1e9
            film.add(at_s, "", world.render(front, *_SIZE_PX))
    finally:
        world.close()
    return film.strip()
