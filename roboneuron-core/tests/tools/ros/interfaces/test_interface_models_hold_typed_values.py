"""pydantic models of interfaces: typed attributes, the encoder's rules, round trips."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from roboneuron.tools.ros.interfaces import LOSSLESS, list_interfaces, load_message
from roboneuron.tools.ros.interfaces.model import attribute_name


def test_a_model_has_typed_attributes_and_defaults() -> None:
    model = load_message("geometry_msgs/msg/PoseStamped").model
    pose = model.model_validate({"pose": {"position": {"x": 3}}})
    assert type(pose.pose.position.x) is float
    assert pose.pose.orientation.w == 1.0
    assert model.model_validate(pose) is pose


def test_a_model_refuses_what_the_encoder_refuses() -> None:
    model = load_message("geometry_msgs/msg/Twist").model
    with pytest.raises(ValidationError, match=r"linear\.x.*got the text"):
        model.model_validate({"linear": {"x": "1"}})
    with pytest.raises(ValidationError, match="did you mean"):
        model.model_validate({"liner": {}})


def test_what_was_omitted_stays_omitted() -> None:
    part = load_message("geometry_msgs/msg/TwistStamped")
    message = part.encode(part.model.model_validate({"twist": {}}), now_ns=7)
    assert message.header.stamp.nanosec == 7
    message = part.encode(part.model.model_validate({"header": {"stamp": 1.5}}), now_ns=7)
    assert message.header.stamp.nanosec == 500_000_000


@pytest.mark.sampled(every=8)
@pytest.mark.parametrize("name", [str(n) for n in list_interfaces() if n.kind == "msg"])
def test_a_model_encodes_to_the_same_message(name: str, interface_values) -> None:
    part = load_message(name)
    for seed in range(3):
        value = interface_values.ValueGenerator(seed).value(part.message)
        direct = part.decode(part.encode(value, now_ns=5), LOSSLESS)
        assert (
            part.decode(part.encode(part.model.model_validate(value), now_ns=5), LOSSLESS) == direct
        )


@pytest.mark.parametrize(
    ("field", "attribute"),
    [
        ("x", "x"),
        ("data", "data"),
        ("copy", "copy_"),
        ("from", "from_"),
        ("model_fields", "model_fields_"),
        ("_x", "x_"),
    ],
)
def test_attribute_names(field: str, attribute: str) -> None:
    assert attribute_name(field) == attribute
