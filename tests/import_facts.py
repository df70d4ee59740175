"""Locations of the core and the plugins, and imports of a file: for tests of the import rules."""

from __future__ import annotations

import ast
import functools
from pathlib import Path

ROOT = Path(__file__).parents[1]
CORE = ROOT / "roboneuron-core" / "src" / "roboneuron"
PLUGINS = ROOT / "plugins"
STANDARD = PLUGINS / "rn-standard" / "src" / "rn_standard"
"""Packages that are each a plugin, in one distribution."""
SENDING_PACKAGE = CORE / "direct_path"
"""The package that sends for agents."""


@functools.cache
def imports_of(path: Path) -> list[tuple[str, int]]:
    """Names that a file imports, with lines; cached, because many tests use them."""
    found: list[tuple[str, int]] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}:{node.lineno} uses a relative import"
            found += [(f"{node.module}.{alias.name}", node.lineno) for alias in node.names]
    return found
