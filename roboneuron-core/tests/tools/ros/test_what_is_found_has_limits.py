"""Endpoints that a pattern found: bounded by the robot's profile, by the pattern, or not exposed at
all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
import pytest
from mcp import Client

from rn_testing.fakes import gantry_profile
from roboneuron.config import feature_options, parse_config
from roboneuron.contract import Endpoint, RobotProfile
from roboneuron.errors import ConfigurationError
from roboneuron.feature import ExposedEndpoint
from roboneuron.server.app import Application
from roboneuron.tools.ros.discovered_limits import check_patterns, limit
from roboneuron.tools.ros.discovery import LiveGraph
from roboneuron.tools.ros.plugin import FEATURE

TWIST = "geometry_msgs/msg/Twist"
RANGES = (
    f'[discover.limits."{TWIST}"]\n"linear.x" = [-0.5, 0.5]\n"angular.z" = [-1, 1]\n"*" = [0, 0]\n'
)


def patterns(text: str) -> Any:
    config = parse_config(f'[robot]\nname = "rover"\n[[discover]]\npattern = "/rover/*"\n{text}')
    return feature_options(FEATURE, config).discover  # type: ignore[union-attr]


def pattern(text: str = "") -> Any:
    kinds = 'kinds = ["read", "publish", "service", "action"]\n'
    return patterns(f"{kinds}{text}")[0]


def found(kind: str, type_name: str, profile: RobotProfile | None = None) -> ExposedEndpoint:
    endpoint = Endpoint(
        name="thing", kind=kind, topic="/rover/thing", type=type_name, summary="", rate_hz=10.0
    )
    return ExposedEndpoint(
        robot="rover",
        namespace="rover",
        label="thing",
        endpoint=endpoint,
        profile=profile,
    )


@pytest.mark.parametrize(
    ("kind", "type_name", "named"),
    [
        ("publish", TWIST, "linear.x, linear.y"),
        ("publish", "std_msgs/msg/Float64MultiArray", "layout.dim.size"),
        ("publish", "std_msgs/msg/Int8", "data"),
        ("publish", "trajectory_msgs/msg/JointTrajectory", "points.positions"),
        ("publish", "sensor_msgs/msg/JointState", "position, velocity, effort"),
        ("service", "lifecycle_msgs/srv/ChangeState", "transition.id"),
        ("action", "test_msgs/action/Fibonacci", "order"),
    ],
)
def test_numbers_that_nothing_limits_are_not_exposed(kind: str, type_name: str, named: str) -> None:
    with pytest.raises(ConfigurationError, match=f"nothing limits {named}"):
        limit(found(kind, type_name), pattern(), ())
    assert (
        limit(
            found(kind, type_name), pattern(f'unlimited = ["{type_name}"]\n'), ()
        ).endpoint.rate_hz
        == 10.0
    )


@pytest.mark.parametrize(
    ("kind", "type_name"),
    [
        ("read", TWIST),
        ("publish", "std_msgs/msg/Bool"),
        ("publish", "std_msgs/msg/Header"),
        ("service", "std_srvs/srv/SetBool"),
    ],
)
def test_what_carries_no_numbers_or_is_only_read_needs_none(kind: str, type_name: str) -> None:
    assert limit(found(kind, type_name), pattern(), ()).endpoint.bounds == {}


def test_a_pattern_limits_by_type_and_a_velocity_ends_in_zero() -> None:
    endpoint = limit(found("publish", TWIST), pattern(RANGES), ()).endpoint
    assert endpoint.bounds["linear.x"] == (-0.5, 0.5)
    assert endpoint.bounds["linear.y"] == (0.0, 0.0)
    assert len(endpoint.bounds) == 6
    assert endpoint.stop_message == "zero"


def test_a_robot_with_joint_limits_lends_them_to_joint_commands() -> None:
    for type_name in ("trajectory_msgs/msg/JointTrajectory", "sensor_msgs/msg/JointState"):
        assert limit(
            found("publish", type_name, gantry_profile()), pattern(), ()
        ).endpoint.joint_limited


def test_an_exposed_endpoint_of_the_same_type_lends_its_limits_which_can_only_be_tightened() -> (
    None
):
    own = Endpoint(
        name="velocity",
        kind="publish",
        topic="cmd_vel",
        type=TWIST,
        summary="Drive.",
        rate_hz=5.0,
        bounds={"linear.x": (-0.2, 0.2)},
        stop_message="zero",
        min_turning_radius_m=0.4,
        repeat_hz=20.0,
    )
    known = ExposedEndpoint(
        robot="rover",
        namespace="rover",
        label="velocity",
        endpoint=own,
        clamp=frozenset({"linear.x"}),
    )
    made = limit(found("publish", TWIST), pattern(), [known])
    assert made.endpoint.bounds == {"linear.x": (-0.2, 0.2)}
    assert (made.endpoint.topic, made.endpoint.rate_hz) == ("/rover/thing", 5.0)
    assert (made.endpoint.min_turning_radius_m, made.clamp) == (0.4, {"linear.x"})
    with pytest.raises(ConfigurationError, match="can only be tightened"):
        limit(found("publish", TWIST), pattern(RANGES), [known])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('unlimited = ["std_msgs/msg/Nothing"]\n', "is called"),
        ('unlimited = ["std_msgs/Bool"]\n', "write the type in full, std_msgs/msg/Bool"),
        (f'[discover.limits."{TWIST}"]\n"linear.x" = [1, -1]\n', "is no range"),
    ],
)
def test_a_wrong_pattern_is_refused_at_the_start(text: str, words: str) -> None:
    discover = patterns(text)
    with pytest.raises(ConfigurationError, match=words):
        check_patterns(discover)


def test_measurements_are_never_written_by_a_pattern() -> None:
    discover = patterns('kinds = ["publish", "read"]\n')
    config = parse_config('[robot]\nname = "rover"\n')
    graph = LiveGraph(
        discover, config, None, tuple, lambda robot: gantry_profile(), lambda found: None
    )  # type: ignore[arg-type]
    names = {
        "/rover/joint_states": "sensor_msgs/msg/JointState",
        "/rover/camera/front/image": "sensor_msgs/msg/Image",
        "/rover/ee_pose": "geometry_msgs/msg/PoseStamped",
        "/rover/horn": "std_msgs/msg/Empty",
        "/rover/wheel": "std_msgs/msg/Float64",
    }
    made = graph._match({"publish": names, "read": names, "service": {}, "action": {}})
    assert [e.topic for e in made if e.endpoint.kind == "publish"] == ["/rover/horn"]
    assert len([e for e in made if e.endpoint.kind == "read"]) == 5


@pytest.mark.ros
@pytest.mark.timeout(90)
def test_a_found_velocity_is_held_to_its_limits(
    make_application: Callable[..., Application], rover: Any
) -> None:
    application = make_application(
        '[robot]\nname = "rover"\n[[discover]]\npattern = "/rover/*"\nkinds = '
        '["publish"]\nperiod_s = 0.1\n' + RANGES
    )
    application.open()

    async def scenario() -> None:
        await application.settle()
        async with Client(application.server) as client:
            with anyio.fail_after(20):
                while not any(
                    t.name == "publish_cmd_vel" for t in (await client.list_tools()).tools
                ):
                    await anyio.sleep(0.05)
            fast = await client.call_tool("publish_cmd_vel", {"message": {"linear": {"x": 2.0}}})
            assert fast.is_error
            assert "allowed is -0.5 .. 0.5" in fast.content[0].text  # type: ignore[union-attr]
            slow = await client.call_tool(
                "publish_cmd_vel", {"message": {"linear": {"x": 0.2}}, "duration_s": 0.1}
            )
            assert slow.structured_content["stopped"]
            with anyio.fail_after(5):
                while [m.linear.x for m in rover.on("cmd_vel")] != [0.2, 0.0]:
                    await anyio.sleep(0.01)

    anyio.run(scenario)
    assert not any(e.endpoint.type == "std_msgs/msg/Int32" for e in application.host.gate.exposed)
