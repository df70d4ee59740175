"""ROS interfaces as typed data: from the installed message classes to schema, model, encoder and
decoder.

Importing this package imports no ROS; loading an interface imports that interface's package only.
"""

from __future__ import annotations

from roboneuron.tools.ros.interfaces.bounds import LOSSLESS, DecodeLimits, InputLimits
from roboneuron.tools.ros.interfaces.description import (
    Array,
    FieldChoice,
    FieldType,
    MessageField,
    MessageType,
    Nested,
    Plain,
    Scalar,
)
from roboneuron.tools.ros.interfaces.interface import (
    ActionInterface,
    Interface,
    InterfaceLoader,
    MessageInterface,
    ServiceInterface,
    load_action,
    load_interface,
    load_message,
    load_service,
)
from roboneuron.tools.ros.interfaces.naming import (
    InterfaceName,
    interface_prefixes,
    list_interfaces,
)
from roboneuron.tools.ros.interfaces.picture import MessagePicture, to_picture

__all__ = [
    "LOSSLESS",
    "ActionInterface",
    "Array",
    "DecodeLimits",
    "FieldChoice",
    "FieldType",
    "InputLimits",
    "Interface",
    "InterfaceLoader",
    "InterfaceName",
    "MessageField",
    "MessageInterface",
    "MessagePicture",
    "MessageType",
    "Nested",
    "Plain",
    "Scalar",
    "ServiceInterface",
    "interface_prefixes",
    "list_interfaces",
    "load_action",
    "load_interface",
    "load_message",
    "load_service",
    "to_picture",
]
