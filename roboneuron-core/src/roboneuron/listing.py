"""Lazy import of names that are listed in a module's stub."""

import ast
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path


def attach(
    package: str, file: str
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` for a module with a stub.

    lazy_loader would also set each name in the package `roboneuron`, where some have another
    meaning.

    Args:
        package: name of the module.
        file: its path; the stub has the same stem.
    """
    # meaning of a stub's dot: the package itself, or that of a module
    above = package if Path(file).stem == "__init__" else package.rpartition(".")[0]
    modules = {
        alias.name: f"{above}.{node.module}" if node.module else above
        for node in ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8")).body
        if isinstance(node, ast.ImportFrom) and node.level
        for alias in node.names
    }
    names = sorted(modules)

    @cache
    def get(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = import_module(modules[name])
        if not hasattr(module, name):  # a module that has not been imported yet
            import_module(f"{modules[name]}.{name}")
        return getattr(module, name)

    return get, lambda: names, names
