"""Identity of a mutant, independent of the layout of its function."""

from __future__ import annotations

import ast
import difflib


def describe_change(before: str, after: str) -> str:
    """The differing statements of two sources of a function: `before -> after`.

    They are compared in the form of `ast.unparse`, one per line and without comments, so that line
    width has no effect.
    """
    lost, came = _statements(before), _statements(after)
    match = difflib.SequenceMatcher(a=lost, b=came, autojunk=False)
    changed = [codes for codes in match.get_opcodes() if codes[0] != "equal"]
    old = [line for _, start, end, _, _ in changed for line in lost[start:end]]
    new = [line for _, _, _, start, end in changed for line in came[start:end]]
    return f"{' '.join(old)} -> {' '.join(new)}"


def _statements(source: str) -> list[str]:
    """Lines of a function, or of an indented method, without their indentation."""
    first = next(line for line in source.splitlines() if line and not line.lstrip().startswith("#"))
    body = ast.parse(f"if True:\n{source}" if first[0].isspace() else source).body
    function = body[0].body[0] if isinstance(body[0], ast.If) else body[0]
    return [line.strip() for line in ast.unparse(function).splitlines()]
