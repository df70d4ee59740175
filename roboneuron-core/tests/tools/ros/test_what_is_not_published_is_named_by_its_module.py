"""A message that does not come is told with the call that starts its publisher."""

from __future__ import annotations

import pytest

from roboneuron.tools.ros.reading import start_hint


@pytest.mark.parametrize(
    ("topic", "call"),
    [
        ("/fr3/ee_pose", "start_control"),
        ("/pair/left/ee_pose", "start_control"),
        ("/fr3/joint_states", "start_robot"),
        ("/fr3/camera/front/image", "start_perception"),
        ("/rover/odometry", "list_topics"),
    ],
)
def test_the_hint_names_the_call(topic: str, call: str) -> None:
    assert call in start_hint(topic)
