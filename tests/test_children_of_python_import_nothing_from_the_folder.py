"""A process that is started as a module imports nothing from the folder in which a person works: a
`signal.py` or `queue.py` there would replace that of Python.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
OTHERS = {
    "rn_driver_ros2control/interfaces/typesupport.py": "a compiler, in a folder of its own",
    "rn_runtime_sglang/process.py": "an interpreter of another environment, perhaps without -P",
}
"""Command lines without the option, and why."""


def command_lines(source: Path) -> Iterator[ast.List | ast.Tuple]:
    """Lists and tuples with -m, which is followed by the name of a module."""
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.List | ast.Tuple) and "-m" in words_of(node):
            yield node


def words_of(node: ast.List | ast.Tuple) -> list[object]:
    return [word.value for word in node.elts if isinstance(word, ast.Constant)]


def test_every_module_is_started_with_a_safe_path() -> None:
    sources = [*ROOT.glob("roboneuron-core/src/**/*.py"), *ROOT.glob("plugins/*/src/**/*.py")]
    found = [(source, node) for source in sources for node in command_lines(source)]
    assert len(found) > 8
    unsafe = {
        source.as_posix().rpartition("/src/")[2]
        for source, node in found
        if not {"-P", "-I"} & set(words_of(node))
    }
    assert unsafe == OTHERS.keys()
