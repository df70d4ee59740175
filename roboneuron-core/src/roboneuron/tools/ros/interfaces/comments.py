"""Comments and units of an interface, from its installed .idl file.

The .idl is the only place where the build tools keep the comment attached to its field. It is used
for descriptions only: types, bounds, constants and defaults come from the Python classes. Without
the file there are no descriptions.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

_TOKEN = re.compile(r'//[^\n]*|#[^\n]*|"(?:\\.|[^"\\])*"|[A-Za-z_][\w]*|[^\s]', re.DOTALL)
_ESCAPE = re.compile(r"\\(.)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class StructComments:
    """The authors' comments on one struct.

    Attributes:
        text: comment on the struct.
        fields: field name -> comment.
        units: field name -> unit, as written in square brackets in the definition.
    """

    text: str = ""
    fields: dict[str, str] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)


NO_COMMENTS = StructComments()


def read_comments(
    prefixes: Sequence[Path], package: str, kind: str, name: str
) -> dict[str, StructComments]:
    """Return the comments by struct name ("Image", "SetBool_Request"); empty when no .idl is
    installed.
    """
    for prefix in prefixes:
        file = prefix / "share" / package / kind / f"{name}.idl"
        if file.is_file():
            return parse_comments(file.read_text(encoding="utf-8", errors="replace"))
    return {}


def parse_comments(idl: str) -> dict[str, StructComments]:
    """Return the comments in the text of an .idl file by struct name."""
    structs: dict[str, StructComments] = {}
    current: StructComments | None = None
    notes: dict[str, str] = {}
    statement: list[str] = []
    tokens = iter(token for token in _TOKEN.findall(idl) if not token.startswith(("//", "#")))
    for token in tokens:
        if token == "@":
            notes.update([_read_annotation(tokens)])
        elif token == "{":
            if statement[:1] == ["struct"]:
                current = structs[statement[1]] = StructComments(text=notes.get("verbatim", ""))
            notes, statement = {}, []
        elif token == "}":
            current, statement = None, []
        elif token == ";":
            if current is not None and statement:
                _note_field(current, statement[-1], notes)
            notes, statement = {}, []
        else:
            statement.append(token)
    return structs


def _note_field(struct: StructComments, name: str, notes: dict[str, str]) -> None:
    if notes.get("verbatim"):
        struct.fields[name] = notes["verbatim"]
    if notes.get("unit"):
        struct.units[name] = notes["unit"]


def _read_annotation(tokens: Iterator[str]) -> tuple[str, str]:
    """Consume `name ( key = "..." , ... )`; the text of the last key is used, adjacent strings are
    joined.
    """
    name, text, depth = next(tokens), "", 0
    for token in tokens:
        if token == "(":
            depth += 1
        elif token == ")":
            depth -= 1
            if depth == 0:
                break
        elif token == ",":
            text = ""
        elif token.startswith('"'):
            text += _ESCAPE.sub(lambda m: "\n" if m[1] == "n" else m[1], token[1:-1])
    return name, " ".join(text.split())
