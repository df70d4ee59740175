"""The cameras of the SO-101's cell: "front" next to the table and "wrist" on the gripper."""

from __future__ import annotations

from rn_simulation.pinhole import PinholeCamera, front_camera, wrist_camera


def cameras() -> tuple[PinholeCamera, ...]:
    """Both simulated cameras; the second is behind the fixed jaw."""
    front = front_camera((0.52, -0.26, 0.40), (0.19, 0.0, 0.05), 45.0)
    return (front, wrist_camera((0.075, 0.0, -0.055), 35.0, 75.0))
