"""The command `roboneuron ros describe`."""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from roboneuron.tools.ros.interfaces import Interface, MessageField, MessageInterface


class Describe:
    """A ROS interface as agents see it: fields, types, bounds, defaults, choices; or its JSON
    schema.
    """

    def configure(self, parser: ArgumentParser) -> None:
        """Arguments of `roboneuron ros describe`."""
        parser.add_argument(
            "type",
            metavar="TYPE",
            nargs="?",
            help="package/msg/Name, package/srv/Name, package/action/Name or package/Name",
        )
        parser.add_argument("--json", action="store_true", help="the JSON schema of each part")
        parser.add_argument(
            "--list",
            metavar="PACKAGE",
            nargs="?",
            const="",
            help="list the installed interfaces instead",
        )

    def run(self, arguments: Namespace) -> int:
        """Print the description, or the names."""
        # heavy: pydantic, numpy
        from roboneuron.errors import ConfigurationError
        from roboneuron.tools.ros.interfaces import list_interfaces, load_interface

        if arguments.list is not None:
            names = list_interfaces(arguments.list or None)
            if not names:
                raise ConfigurationError(f"No package called {arguments.list!r} holds interfaces.")
            sys.stdout.write("".join(f"{name}\n" for name in names))
            return 0
        if arguments.type is None:
            raise ConfigurationError(
                "No type was given.", hint="Try `roboneuron ros describe geometry_msgs/msg/Twist`."
            )
        parts = parts_of(load_interface(arguments.type))
        if arguments.json:
            schemas = {word: part.json_schema() for word, part in parts.items()}
            sys.stdout.write(
                json.dumps(schemas if len(schemas) > 1 else next(iter(schemas.values())), indent=2)
                + "\n"
            )
            return 0
        for word, part in parts.items():
            sys.stdout.write(to_text(part, word) + "\n")
        return 0


def parts_of(interface: Interface) -> dict[str, MessageInterface]:
    """The message, or the parts of a service or an action, by name."""
    from roboneuron.tools.ros.interfaces import ActionInterface, ServiceInterface

    if isinstance(interface, ServiceInterface):
        return {"request": interface.request, "response": interface.response}
    if isinstance(interface, ActionInterface):
        return {"goal": interface.goal, "result": interface.result, "feedback": interface.feedback}
    return {"message": interface}


def to_text(part: MessageInterface, word: str) -> str:
    """One line per field at every depth, indented."""
    lines = [f"{part.name} ({word})"]
    if part.message.text:
        lines.append(f"  {part.message.text[:400]}")
    lines += [_line(path, field, part) for path, field in part.message.walk()] or ["  (no fields)"]
    return "\n".join(lines) + "\n"


def _line(path: str, field: MessageField, part: MessageInterface) -> str:
    from roboneuron.tools.ros.interfaces.schema import field_text

    indent = "  " * (path.count(".") + 1)
    head = f"{indent}{field.name}: {_type_text(field.type)}"
    if field.default is not None:
        head += f" = {json.dumps(field.default)[:60]}"
    if field.choices:
        listed = ", ".join(f"{choice.name}={choice.value}" for choice in field.choices[:12])
        head += f" {{{listed}{', ...' if len(field.choices) > 12 else ''}}}"
    if path in part.message.required:
        head += " (required)"
    text = field_text(field)
    return f"{head}  # {text}" if text else head


def _type_text(field_type: object) -> str:
    from roboneuron.tools.ros.interfaces import Array, Nested, Scalar

    if isinstance(field_type, Array):
        bound = (
            field_type.size
            if field_type.fixed
            else ""
            if field_type.size is None
            else f"<={field_type.size}"
        )
        return f"{_type_text(field_type.element)}[{bound}]"
    if isinstance(field_type, Nested):
        return field_type.message.type_name
    assert isinstance(field_type, Scalar)
    return (
        field_type.ros
        if field_type.max_length is None
        else f"{field_type.ros}<={field_type.max_length}"
    )
