"""Names of calls that execute code from data or pass text to a shell, and their detection in source
text.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

UNPICKLES = "loads a pickle, which can run code of whoever wrote it"
EVALUATES = "runs text as code"
UNSAFE: dict[str, str] = {
    **dict.fromkeys(
        (
            *(
                f"{module}.{name}"
                for module in ("pickle", "_pickle", "dill", "cloudpickle")
                for name in ("load", "loads")
            ),
            *(
                "pickle.Unpickler",
                "pickle._Unpickler",
                "joblib.load",
                "pandas.read_pickle",
                "shelve.open",
            ),
            *("jsonpickle.decode", "marshal.load", "marshal.loads"),
        ),
        UNPICKLES,
    ),
    **dict.fromkeys(("eval", "exec", "yaml.unsafe_load", "yaml.full_load"), EVALUATES),
    **dict.fromkeys(
        ("os.system", "os.popen", "subprocess.getoutput", "subprocess.getstatusoutput"),
        "runs a shell",
    ),
    "tempfile.mktemp": "names a file that somebody else may make meanwhile; use mkstemp",
}
"""Reason against a call with any arguments, by qualified name."""
UNLESS: dict[str, tuple[str, object, str]] = {
    "torch.load": ("weights_only", True, UNPICKLES),
    "yaml.load": ("Loader", ("SafeLoader", "CSafeLoader"), EVALUATES),
}
"""Argument that a call must have, by qualified name."""
IF: dict[str, tuple[str, object, str]] = {
    "numpy.load": ("allow_pickle", True, UNPICKLES),
    **{
        f"subprocess.{name}": ("shell", True, "runs a shell")
        for name in ("run", "call", "check_call", "check_output", "Popen")
    },
}
"""Argument that a call must not have, by qualified name."""


def _aliases(tree: ast.AST) -> dict[str, str]:
    """Qualified names by their local names in a file."""
    found: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                top = alias.name.partition(".")[0]
                found[alias.asname or top] = alias.name if alias.asname else top
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            for alias in node.names:
                found[alias.asname or alias.name] = f"{node.module}.{alias.name}"
    return found


def _qualified(node: ast.expr, aliases: dict[str, str]) -> str:
    """Dotted name of the called object; empty if it is no plain name, such as a method of a
    value.
    """
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.insert(0, node.attr)
        node = node.value
    if not isinstance(node, ast.Name):
        return ""
    if node.id in aliases:
        return ".".join((aliases[node.id], *parts))
    return "" if parts else node.id


def _value(node: ast.expr) -> object:
    if isinstance(node, ast.Constant):
        return node.value
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", None)


def unsafe_calls(path: Path) -> Iterator[tuple[int, str, str]]:
    """Line, name and reason of each such call in a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
    aliases = _aliases(tree)
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        name = _qualified(node.func, aliases)
        arguments = {word.arg: _value(word.value) for word in node.keywords if word.arg}
        if name == "yaml.load" and len(node.args) > 1:
            arguments["Loader"] = _value(node.args[1])
        if name in UNSAFE:
            yield node.lineno, name, UNSAFE[name]
        elif name in UNLESS:
            wanted, good, reason = UNLESS[name]
            given = arguments.get(wanted)
            if given is not good and not (isinstance(good, tuple) and given in good):
                yield node.lineno, name, reason
        elif name in IF and arguments.get(IF[name][0]) is IF[name][1]:
            yield node.lineno, name, IF[name][2]
