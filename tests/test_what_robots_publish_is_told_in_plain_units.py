"""Transforms, detections and batteries: an agent reads them with typed tools, and positions are
transformed between frames.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest

from rn_interfaces.finder import PREFIXES
from rn_testing.agent import Agent, client_of
from rn_testing.domain import free_ros_domain
from rn_testing.waiting import wait_for_line
from roboneuron.direct_path.fields import filled, load_type
from roboneuron.tools.ros.battery import battery_of
from roboneuron.tools.ros.detections import GetDetections, detections_of
from roboneuron.tools.ros.newest import GetNewest

HERE = Path(__file__).parent
EXAMPLES = HERE.parent / "examples"
CONFIG = """
[robot]
name = "diffdrive"
[supervisor]
state_directory = "{state}"
[direct_path]
transforms = "/tf"
[[expose]]
name = "tf"
kind = "read"
topic = "/tf"
type = "tf2_msgs/msg/TFMessage"
[[expose]]
name = "seen"
kind = "read"
topic = "seen"
type = "vision_msgs/msg/Detection3DArray"
[[expose]]
name = "seen_flat"
kind = "read"
topic = "seen_flat"
type = "vision_msgs/msg/Detection2DArray"
[[expose]]
name = "battery"
kind = "read"
topic = "battery"
type = "sensor_msgs/msg/BatteryState"
[[expose]]
name = "goal"
kind = "publish"
topic = "goal"
type = "geometry_msgs/msg/PoseStamped"
frame = "map"
bounds = {{ "pose.position.x" = [-5, 5], "pose.position.y" = [-5, 5] }}
zones = [{{ name = "stairs", lower_m = [3.0, 0.5, -1.0], upper_m = [4.0, 1.5, 1.0] }}]
"""


@pytest.fixture(scope="module")
def user(learnt_types: None) -> dict[str, str]:
    """The environment of a user who has learnt the types of the examples; this process has learnt
    them too.
    """
    environment = {**os.environ, "ROS_DOMAIN_ID": str(free_ros_domain())}
    environment.pop(PREFIXES)
    return environment


# A battery


def battery(**values: Any) -> Any:
    return filled(load_type("sensor_msgs/msg/BatteryState"), values)


def told(**values: Any) -> Any:
    return battery_of("base", battery(**values), GetNewest(), 0.25)


def test_a_battery_is_told_by_names_and_what_it_does_not_measure_is_null() -> None:
    nothing = math.nan
    found = told(
        percentage=0.85, voltage=24.1, current=-2.5, temperature=nothing, charge=nothing,
        capacity=math.inf, power_supply_status=2, power_supply_health=1, power_supply_technology=3,
        present=True,
    )  # fmt: skip
    assert (found.charge, found.voltage_v, found.current_a) == (0.85, 24.1, -2.5)
    assert (found.temperature_c, found.charge_ah, found.capacity_ah) == (None, None, None)
    assert (found.status, found.health, found.technology) == ("discharging", "good", "lipo")
    assert (found.present, found.age_s, found.problems) == (True, 0.25, [])


@pytest.mark.parametrize("value", [85.0, 1.01, -0.1])
def test_a_charge_that_is_no_share_is_not_told_as_one(value: float) -> None:
    found = told(percentage=value)
    assert found.charge is None
    assert f"percentage is {value:g}, the definition says 0 .. 1" in found.problems[0]


def test_a_charge_that_is_not_measured_is_no_problem() -> None:
    assert (told(percentage=math.nan).charge, told(percentage=math.nan).problems) == (None, [])
    assert (told(percentage=0.0).charge, told(percentage=1.0).charge) == (0.0, 1.0)


def test_a_state_without_a_name_is_a_problem() -> None:
    found = told(power_supply_status=77)
    assert found.status == "77"
    assert found.problems == ["power_supply_status is 77, which has no name"]


# Detections


def seen(*things: dict[str, Any], flat: bool = False, stamp_s: int = 0) -> Any:
    kind = load_type(f"vision_msgs/msg/Detection{2 if flat else 3}DArray")
    header = {"frame_id": "camera", "stamp": {"sec": stamp_s}}
    return filled(kind, {"header": header, "detections": list(things)})


def thing(score: float, name: str = "cup", **box: Any) -> dict[str, Any]:
    return {"results": [{"hypothesis": {"class_id": name, "score": score}}], "bbox": box}


def sees(message: Any, **arguments: Any) -> Any:
    return detections_of("base", message, GetDetections(**arguments), 0.5)


def test_detections_are_told_the_surest_first_and_no_more_than_asked_for(
    user: dict[str, str],
) -> None:
    found = sees(seen(*(thing(score / 10) for score in range(10))), entries=3, min_score=0.25)
    assert [one.score for one in found.detections] == [0.9, 0.8, 0.7]
    assert (found.more, found.damaged, found.age_s) == (4, 0, 0.5)
    assert sees(seen(thing(0.9), thing(0.1, "plate")), class_id="plate").detections[0].score == 0.1


def test_of_several_hypotheses_the_surest_is_told(user: dict[str, str]) -> None:
    one = thing(0.2, "plate")
    one["results"] += thing(0.7, "cup")["results"] + thing(math.nan, "bowl")["results"]
    assert sees(seen(one)).detections[0].class_id == "cup"


def test_boxes_have_their_unit_and_frame(user: dict[str, str]) -> None:
    center = {"position": {"x": 0.5, "z": 1.0}, "orientation": {"w": 1.0}}
    spatial = sees(seen(thing(0.5, center=center, size={"x": 0.1})))
    (box,) = spatial.detections
    assert (spatial.unit, spatial.frame, box.frame) == ("m", "camera", "camera")
    assert (box.center, box.size, box.theta_rad) == ([0.5, 0.0, 1.0], [0.1, 0.0, 0.0], None)
    assert box.quaternion_xyzw == [0.0, 0.0, 0.0, 1.0]
    turned = {"position": {"x": 320.0, "y": 240.0}, "theta": 0.5}
    flat = sees(seen(thing(0.5, center=turned, size_x=40.0, size_y=20.0), flat=True))
    (box,) = flat.detections
    assert (flat.unit, box.center, box.size) == ("px", [320.0, 240.0], [40.0, 20.0])
    assert (box.theta_rad, box.quaternion_xyzw) == (0.5, None)


def test_damaged_detections_are_counted_and_left_out(user: dict[str, str]) -> None:
    broken = thing(0.5, center={"position": {"x": math.nan}})
    found = sees(seen(broken, {"id": "nothing"}, thing(math.nan), thing(0.1)))
    assert [one.score for one in found.detections] == [0.1, None]
    assert found.damaged == 2


def test_the_age_is_that_of_the_picture(user: dict[str, str]) -> None:
    found = sees(seen(thing(0.5), stamp_s=int(time.time()) - 30))
    assert 29.0 < found.age_s < 35.0


# A server


@pytest.fixture
def talker(user: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, str(HERE / "sensor_talker.py"), "diffdrive"]
    with subprocess.Popen(command, env=user, stdout=subprocess.PIPE, text=True) as process:
        wait_for_line(process.stdout, "talking")
        yield process
        process.terminate()


@pytest.mark.ros
@pytest.mark.exhaustive
@pytest.mark.timeout(120)
def test_an_agent_asks_a_server_for_them(
    user: dict[str, str], talker: subprocess.Popen[str], tmp_path: Path
) -> None:
    config = tmp_path / "roboneuron.toml"
    config.write_text(CONFIG.format(state=tmp_path / "state"))

    async def scenario() -> None:
        async with client_of(config, user) as client:
            agent = Agent(client)
            await transforms(agent)
            await sensors(agent)
            await places(agent)

    async def transforms(agent: Agent) -> None:
        _, found, text = await agent.call(
            "lookup_tf", target="map", source="camera", timeout_s=30.0
        )
        assert (found["x_m"], found["y_m"]) == pytest.approx((2.5, 1.0)), text
        assert found["frames"] == ["camera", "base", "odom", "map"]
        assert found["age_s"] < 1.0
        asked = {"target": "map", "timeout_s": 2.0}
        assert "not connected" in await agent.fail("lookup_tf", source="stray", **asked)
        assert "s old, allowed is 1 s" in await agent.fail("lookup_tf", source="late", **asked)
        assert "'gripper' is unknown" in await agent.fail("lookup_tf", source="gripper", **asked)

    async def sensors(agent: Agent) -> None:
        _, found, text = await agent.call("get_battery", timeout_s=30.0)
        assert (found["charge"], found["status"]) == (0.15, "discharging"), text
        assert found["temperature_c"] is None
        _, found, text = await agent.call("get_seen", class_id="cup", entries=5, timeout_s=30.0)
        assert [one["id"] for one in found["detections"]] == ["29", "27", "25", "23", "21"], text
        assert (found["more"], found["unit"], found["frame"]) == (10, "m", "camera")
        _, found, text = await agent.call("get_seen_flat", timeout_s=30.0)
        assert found["detections"][0]["center"] == [320.0, 0.0], text

    async def places(agent: Agent) -> None:
        def goal(x: float, frame: str) -> dict[str, Any]:
            pose = {"position": {"x": x}, "orientation": {"w": 1.0}}
            return {"message": {"header": {"frame_id": frame}, "pose": pose}, "timeout_s": 30.0}

        _, sent, text = await agent.call("publish_goal", **goal(0.0, "camera"))
        assert sent["allowed"], text
        assert [(c["path"], c["sent"]) for c in sent["clamped"]][:2] == [
            ("pose.position.x", 2.5),
            ("pose.position.y", 1.0),
        ]
        assert wait_for_line(talker.stdout, "map ") == "map 2.5 1.0\n"
        assert "in the zone 'stairs'" in await agent.fail("publish_goal", **goal(1.0, "camera"))
        assert "pose.position.x is" in await agent.fail("publish_goal", **goal(4.0, "camera"))
        assert "s old, allowed is 1 s" in await agent.fail("publish_goal", **goal(0.0, "late"))

    anyio.run(scenario)
