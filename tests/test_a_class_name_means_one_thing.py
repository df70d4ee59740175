"""No two classes in the sources have the same name, so that a name is unambiguous."""

from __future__ import annotations

import ast
import re
from collections import Counter, defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]


def classes_by_name(folders: list[Path]) -> dict[str, list[str]]:
    """Definitions of each class by name, including nested ones.

    Names that no two lines define have no place: to parse their files would take seconds.
    """
    paths = sorted(path for folder in folders for path in folder.rglob("*.py"))
    # also of classes inside strings
    named = {
        path: re.findall(r"^\s*class\s+(\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        for path in paths
    }
    counts = Counter(name for names in named.values() for name in names)
    found: defaultdict[str, list[str]] = defaultdict(list, {name: [] for name in counts})
    for path, names in named.items():
        if all(counts[name] == 1 for name in names):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                found[node.name].append(f"{path}:{node.lineno}")
    return found


def test_no_class_name_occurs_twice():
    folders = [ROOT / "roboneuron-core/src", *(ROOT / "plugins").glob("*/src")]
    found = classes_by_name(folders)
    assert len(found) > 1000
    assert {name: places for name, places in found.items() if len(places) > 1} == {}, (
        "rename the one that is not public, or let both packages use one class"
    )


def test_a_repeated_name_is_found_wherever_it_is_defined(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
    (first / "gate.py").write_text("class Policy:\n    class Options: ...\n", encoding="utf-8")
    (second / "cell.py").write_text(
        "def make():\n    class Options: ...\n    return Options\n", encoding="utf-8"
    )
    found = classes_by_name([first, second])
    assert {name: len(places) for name, places in found.items()} == {"Policy": 1, "Options": 2}
