"""A chunk of positions from the backend to the command topic: each row with the following ones,
within the horizon of control.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from rn_testing.waiting import holds_within
from roboneuron.contract import Frame, JointSample
from roboneuron.ros.messages import to_image, to_joint_state

pytestmark = pytest.mark.ros
REPLACED = {
    '"instant"': '"planner"',
    '"adder"': '"follower"',
    "action_timeout_s = 0.3": "action_timeout_s = 1.0\nhorizon_s = 0.15",
}


@pytest.mark.parametrize(("replaced", "points"), [(REPLACED, 4), ({}, 1)], ids=["horizon", "none"])
def test_each_row_goes_out_with_those_that_are_planned_after_it(
    world: Any, replaced: dict[str, str], points: int
) -> None:
    from sensor_msgs.msg import JointState

    words = {**REPLACED, "action_timeout_s = 0.3": "action_timeout_s = 1.0", **replaced}
    actions = world.listen(Float64MultiArray, "action")
    commands = world.listen(JointTrajectory, "joint_trajectory")
    for kind in ("control", "inference"):
        world.start(kind, replace=words)
    states = world.publisher(JointState, "joint_states")
    images = world.publisher(Image, "camera/front/image")

    def tell() -> bool:
        """Deliver state and image; return whether they led to commands for a whole chunk."""
        now_ns = world.node.get_clock().now().nanoseconds
        rest = JointSample(names=("a", "b"), position=np.zeros(2), stamp_ns=now_ns)
        states.publish(to_joint_state(rest))
        image = np.zeros((6, 8, 3), dtype=np.uint8)
        images.publish(
            to_image(Frame(camera="front", image=image, stamp_ns=now_ns, frame_id="optical"))
        )
        return len(commands) > 8

    assert holds_within(tell, 30.0)
    sizes = [len(message.data) // 2 for message in actions]
    assert max(sizes) == points
    assert max(len(message.points) for message in commands) == points
    assert min(sizes) == 1, "the last row of a chunk has none after it"
