"""What a module's server announces before it sends a request to the module.

ROS does not tell who has sent a request, and anybody on the graph may send one. The server
therefore announces each lifecycle transition and each change of parameters over the module's stdin,
a pipe that nobody else holds, by a digest of its content; it lies there before the request is
sent. A feature refuses what was not announced.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter


def digest_of(request: object) -> bytes:
    """SHA-256, in hexadecimal, of a request with all that it asks for.

    It is the same in the server and in the module, whatever their interpreters.

    Args:
        request: of a service.
    """
    text = json.dumps(request, default=_contents, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest().encode()


def _contents(value: Any) -> object:
    """Fields of a message, or elements of an array: not its `repr`, which differs between
    distributions of ROS.
    """
    if hasattr(value, "get_fields_and_field_types"):
        return {name: getattr(value, name) for name in value.get_fields_and_field_types()}
    return [str(element) for element in value]


def parameters_request(values: Mapping[str, str | int]) -> SetParameters.Request:
    """The request to set these parameters."""
    parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    return SetParameters.Request(parameters=parameters)
