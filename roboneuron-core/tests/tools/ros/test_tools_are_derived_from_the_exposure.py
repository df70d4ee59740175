"""Names, schemas and descriptions of derived tools; what a configuration may expose; what is too
many to be listed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rn_testing.fakes import fake_registry, gantry_profile
from roboneuron.config import feature_options, parse_config
from roboneuron.contract import Endpoint
from roboneuron.direct_path.feature import direct_path
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.errors import ConfigurationError
from roboneuron.server.app import Application
from roboneuron.tools.ros.exposure import Exposure, exposure
from roboneuron.tools.ros.interfaces import list_interfaces, load_message
from roboneuron.tools.ros.naming import PATTERNS, to_label, tool_name
from roboneuron.tools.ros.options import ExposeConfig, RosToolsOptions
from roboneuron.tools.ros.plugin import FEATURE
from roboneuron.tools.ros.schemas import decoded_schema

Make = Callable[..., Application]
TWIST = 'kind = "publish"\ntopic = "cmd_vel"\ntype = "geometry_msgs/msg/Twist"\n'


def exposed(text: str, *added: ExposeConfig) -> Exposure:
    registry = fake_registry(DIRECT_PATH, FEATURE)
    config = parse_config(text)
    options = feature_options(FEATURE, config)
    assert isinstance(options, RosToolsOptions)
    return exposure(config, options, registry, added)


def tools(application: Application) -> dict[str, Any]:
    return {tool.name: tool for tool in application.tools.listing()}


def test_every_exposed_endpoint_is_a_tool_with_strict_schemas(application: Application) -> None:
    found = tools(application)
    expected = {
        *(
            "publish_velocity",
            "publish_velocity_sequence",
            "publish_speech",
            "publish_speech_sequence",
        ),
        *(
            "publish_latched",
            "publish_lonely",
            "read_battery",
            "read_picture",
            "call_light",
            "call_absent",
        ),
        *(
            "send_count_goal",
            "get_parameters",
            "set_parameters",
            "list_parameters",
            "describe_parameters",
        ),
    }
    assert expected <= set(found)
    for name in expected:
        tool = found[name]
        for schema in (tool.input_schema, tool.output_schema):
            jsonschema.Draft202012Validator.check_schema(schema)
        assert tool.input_schema["additionalProperties"] is False
        reads = name.startswith(("read_", "get_", "list_", "describe_"))
        assert tool.annotations.read_only_hint == reads


def test_robots_that_share_an_endpoint_share_a_tool(application: Application) -> None:
    tool = tools(application)["publish_velocity"]
    assert tool.input_schema["properties"]["robot"]["enum"] == ["rover", "second"]
    assert tool.input_schema["required"] == ["robot", "message"]
    x = tool.input_schema["properties"]["message"]["properties"]["linear"]["properties"]["x"]
    # what any of them allows; the gate knows each one's
    assert (x["minimum"], x["maximum"]) == (-0.5, 0.5)
    assert (
        "second: Drive slowly. On /second/cmd_vel. Limits: linear.x -0.1 .. 0.1."
        in tool.description
    )


def test_two_types_under_one_name_are_told_apart_by_the_robot(make_application: Make) -> None:
    text = (
        '[robot]\nname = "rover"\n[[expose]]\nname = "velocity"\n'
        + TWIST
        + '[[expose]]\nrobot = "second-one"\n'
        'name = "velocity"\n' + TWIST.replace("Twist", "TwistStamped")
    )
    assert {"publish_velocity", "publish_second_one_velocity"} <= set(tools(make_application(text)))


def test_a_label_may_be_used_for_two_kinds(make_application: Make) -> None:
    text = (
        '[robot]\nname = "rover"\n[[expose]]\nname = "velocity"\n'
        + TWIST
        + '[[expose]]\nname = "velocity"\n'
        'kind = "read"\ntopic = "cmd_vel"\ntype = "geometry_msgs/msg/Twist"\n'
    )
    application = make_application(text)
    assert {"publish_velocity", "read_velocity"} <= set(tools(application))
    assert {e.endpoint.name for e in direct_path(application.host).judge.allowed()} == {
        "velocity_publish",
        "velocity_read",
    }


@given(st.text(max_size=120), st.sampled_from(sorted(PATTERNS)))
def test_names_are_short_and_valid_whatever_the_label(label: str, use: str) -> None:
    name = tool_name(use, to_label(label) or "x", "robot", ())
    assert len(name) <= 64
    assert name.replace("_", "a").isalnum()
    assert name == tool_name(use, to_label(label) or "x", "robot", ())
    assert tool_name(use, to_label(label) or "x", "robot", {name}) != name


BAD = [
    ('[[expose]]\nname = "velocity"\n', "lacks kind, topic, type"),
    (
        '[[expose]]\nname = "v"\nkind = "publish"\ntopic = "../x"\ntype = "std_msgs/msg/Bool"\n',
        "is not a topic name",
    ),
    (
        '[[expose]]\nname = "v"\nkind = "service"\ntopic = "x"\ntype = "std_msgs/msg/Bool"\n',
        "cannot be of",
    ),
    (
        '[[expose]]\nname = "v"\n' + TWIST + 'bounds = { "linear.w" = [0, 1] }\n',
        "has no number 'linear.w'",
    ),
    (
        '[[expose]]\nname = "v"\n'
        + TWIST
        + ('bounds = { "linear.x" = [1, 2] }\nstop_message = "zero"\n'),
        "is zero",
    ),
    ('[[expose]]\nname = "v"\n' + TWIST + 'clamp = ["linear.x"]\n', "nothing bounds it"),
    (
        '[[expose]]\nname = "v"\n' + TWIST + "stop_message = { linear = { q = 1 } }\n",
        "unknown field 'q'",
    ),
    ('[[expose]]\nname = "p"\nkind = "parameters"\n', "needs `name` and `topic`"),
    ('[[expose]]\nrobot = "stranger"\n', "no installed plugin offers such a robot"),
    (
        '[[expose]]\nrobot = "a"\nnamespace = "x"\nname = "v"\n'
        + TWIST
        + '[[expose]]\nrobot = "a"\nnamespace = "y"\n'
        'name = "w"\n' + TWIST,
        "two namespaces",
    ),
]


@pytest.mark.parametrize(("text", "words"), BAD, ids=[words for _, words in BAD])
def test_what_cannot_be_exposed_is_refused_by_name(text: str, words: str) -> None:
    with pytest.raises(ConfigurationError, match=words.replace("(", "\\(")):
        exposed('[robot]\nname = "rover"\n' + text)


OWN = (
    "/diagnostics",
    "/rosout",
    "/parameter_events",
    "action",
    "joint_states",
    "ee_pose",
    "predictions",
    "odometry",
)
OWN += (
    "camera/front/image",
    "camera/front/camera_info",
    "emergency_stop",
    "robot/transition_event",
    "sim/state",
)


@pytest.mark.parametrize("topic", OWN)
def test_what_roboneuron_writes_itself_is_not_exposed_for_publishing(
    topic: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    odometry = Endpoint(
        name="odometry", kind="read", topic="odometry", type="std_msgs/msg/Bool", summary="Where."
    )
    profile = replace(gantry_profile(), endpoints=(odometry,), own_topics=("sim/state",))
    monkeypatch.setattr(
        "roboneuron.tools.ros.exposure.load_profile", lambda registry, name: profile
    )
    entry = (
        f'[[expose]]\nname = "v"\nkind = "publish"\ntopic = "{topic}"\ntype = "std_msgs/msg/Bool"\n'
    )
    for absolute in (entry, entry.replace(f'"{topic}"', f'"/gantry/{topic}"')):
        if "/gantry//" not in absolute:
            with pytest.raises(ConfigurationError, match=f"{topic} is written by RoboNeuron alone"):
                exposed(f'[robot]\nname = "gantry"\n{absolute}')
    monkeypatch.setenv("ROBONEURON_SIMULATOR_TRUTH", "on")
    assert exposed(f'[robot]\nname = "gantry"\n{entry.replace("publish", "read")}').endpoints


@pytest.mark.parametrize(
    "topic", ["lamp", "camera/front/exposure", "robot/lamp", "/rosout_agg", "sim/reset"]
)
def test_other_topics_may_be_exposed_for_publishing(topic: str) -> None:
    entry = (
        f'[[expose]]\nname = "v"\nkind = "publish"\ntopic = "{topic}"\ntype = "std_msgs/msg/Bool"\n'
    )
    assert exposed(f'[robot]\nname = "gantry"\n{entry}').endpoints


def test_a_profile_is_tightened_not_widened() -> None:
    config = (
        '[robot]\nname = "gantry"\n[[expose]]\nname = "joint_states"\nrate_hz = 2.0\nsummary '
        '= "Joints."\n'
    )
    made = exposed(config)
    joints = next(e for e in made.endpoints if e.label == "joint_states")
    assert (joints.endpoint.rate_hz, joints.endpoint.summary, joints.endpoint.kind) == (
        2.0,
        "Joints.",
        "read",
    )
    off = '[robot]\nname = "gantry"\n[direct]\nprofile = false\n'
    assert exposed(off).endpoints == ()


def test_too_many_tools_are_found_by_search_and_called_by_name(make_application: Make) -> None:
    import anyio
    from mcp import Client

    entries = "".join(
        f'[[expose]]\nname = "wheel_{i}"\nkind = "publish"\ntopic = "w{i}"\ntype = '
        '"geometry_msgs/msg/Twist"\n'
        for i in range(200)
    )
    application = make_application('[robot]\nname = "rover"\n' + entries)
    listed = tools(application)
    assert {"find_tools", "call_tool"} <= set(listed)
    assert "publish_wheel_7" not in listed
    assert len(listed) < 40

    async def ask() -> None:
        async with Client(application.server) as client:
            found = (
                await client.call_tool("find_tools", {"query": "wheel 137", "schemas": True})
            ).structured_content
            assert found["tools"][0]["name"] == "publish_wheel_137"
            assert found["total"] >= 400
            arguments = {"message": {"linear": {"x": "fast"}}}
            for name, call in (
                ("call_tool", {"tool": "publish_wheel_137", "arguments": arguments}),
                ("publish_wheel_137", arguments),
            ):
                answer = await client.call_tool(name, call)
                assert answer.is_error
                assert "linear.x" in answer.content[0].text  # type: ignore[union-attr]
            missing = await client.call_tool(
                "call_tool", {"tool": "publish_whel_137", "arguments": {}}
            )
            assert missing.is_error

    anyio.run(ask)


def test_the_output_schema_fits_what_is_decoded_of_every_message() -> None:
    for name in list_interfaces():
        if name.kind == "msg":
            part = load_message(str(name))
            jsonschema.validate(
                part.decode(part.ros_type()), decoded_schema(part), jsonschema.Draft202012Validator
            )


def test_a_velocity_ends_in_zero_unless_the_configuration_says_otherwise() -> None:
    def stop(more: str) -> str:
        text = '[robot]\nname = "rover"\n[[expose]]\nname = "v"\n' + TWIST + more
        return exposed(text).endpoints[0].endpoint.stop_message

    assert (stop(""), stop('stop_message = ""\n')) == ("zero", "")
    with pytest.raises(ConfigurationError, match="is zero"):
        stop('bounds = { "linear.x" = [1, 2] }\n')
