"""A backend's declared space is checked before loading, and its chunks must be in it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray

from rn_testing.waiting import holds_within
from roboneuron.config import parse_config
from roboneuron.contract import Frame
from roboneuron.errors import PlanningError, PluginError, RoboNeuronError
from roboneuron.modules.inference.agreement import SpaceAgreement
from roboneuron.plugins.specs import BackendSpec
from roboneuron.ros.messages import to_image

CONFIG = """
[robot]
name = "pair"
[control]
controller = "follower"
"""


@pytest.fixture
def ask(make_host: Any) -> Any:
    """Return a function that checks the backend "fickle" with other fields of its descriptor."""
    from roboneuron.modules import module_host

    def ask(kind: str, config: str = CONFIG, **facts: Any) -> Any:
        registry = module_host.discover(())
        spec = replace(registry.get(BackendSpec, "fickle"), **facts)
        return SpaceAgreement.of(
            registry, spec, {"kind": kind}, "pair", parse_config(config).control
        )

    return ask


@pytest.mark.parametrize("kind", ["ee_delta", "ee_pose", "joint_position", "joint_velocity"])
def test_a_space_that_both_sides_know_is_agreed_on(ask: Any, kind: str) -> None:
    assert ask(kind).executed.kind == kind


def test_a_backend_that_declares_nothing_yields_actions(ask: Any) -> None:
    assert ask("joint_velocity", space=None).executed.kind == "ee_delta"


@pytest.mark.parametrize(
    ("kind", "facts", "error", "match"),
    [
        ("number", {}, PluginError, "'fickle' returned int, expected ControlSpace"),
        ("torque", {}, RoboNeuronError, "'torque' is no control space"),
        ("joint_delta", {}, PluginError, "does not say needs_state"),
        ("joint_velocity", {"space": "loop_plugin:absent"}, PluginError, "absent"),
    ],
)
def test_a_declaration_that_is_none_is_refused(
    ask: Any, kind: str, facts: dict[str, Any], error: type[Exception], match: str
) -> None:
    with pytest.raises(error, match=match):
        ask(kind, **facts)


def test_deltas_are_resolved_for_a_backend_that_is_given_the_joints(ask: Any) -> None:
    agreement = ask("joint_delta", needs_state=True)
    assert agreement.executed.label == "joint_position@50:a,b"


def test_the_configured_controller_decides(ask: Any) -> None:
    other = CONFIG.replace("follower", "adder")
    assert ask("ee_delta", other).executed.kind == "ee_delta"
    with pytest.raises(PlanningError, match="controller 'adder' executes ee_delta"):
        ask("joint_velocity", other)


def test_the_configured_timeout_decides(ask: Any) -> None:
    with pytest.raises(PlanningError, match=r"50 rows a second are too few.*action_timeout_s"):
        ask("joint_velocity", CONFIG + "action_timeout_s = 0.02\n")


@pytest.mark.ros
def test_a_chunk_of_another_space_ends_the_actions_with_one_error(
    world: Any, status_of: Any
) -> None:
    actions = world.listen(Float64MultiArray, "action")
    replaced = {'"instant"': '"fickle"', '"adder"': '"follower"'}
    inference = world.start("inference", replace=replaced)
    images = world.publisher(Image, "camera/front/image")

    def send_image() -> None:
        now_ns = world.node.get_clock().now().nanoseconds
        image = np.zeros((6, 8, 3), dtype=np.uint8)
        images.publish(
            to_image(Frame(camera="front", image=image, stamp_ns=now_ns, frame_id="optical"))
        )

    send_image()
    assert holds_within(lambda: len(actions) == 1)
    assert actions[0].layout.dim[0].label == "joint_velocity@50:a,b"
    assert list(actions[0].data) == [0.1, -0.1]
    assert status_of(inference)["space"] == "joint_velocity@50:a,b"
    from rclpy.parameter import Parameter

    asked = [Parameter("instruction", value="another")]
    world.run(lambda: inference.set_parameters(asked))
    send_image()
    told = "The backend answered in ee_delta (dx_m, dy_m, dz_m, rx_rad, ry_rad, rz_rad"
    assert holds_within(lambda: told in status_of(inference)["message"])
    assert "it declares joint_velocity (a, b at 50 Hz)" in status_of(inference)["message"]
    assert len(actions) == 1
