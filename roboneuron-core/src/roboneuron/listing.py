"""Names that are listed in a stub beside a module, and imported when they are first asked for."""

import ast
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path


def attach(
    package: str, file: str
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a module whose stub lists what it offers.

    lazy_loader would keep each name in the package `roboneuron` too, where some mean something
    else.

    Args:
        package: name of the module.
        file: its path; the stub has the same stem.
    """
    # what a stub's dot means: the package itself, or that of a module
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
        if not hasattr(module, name):  # a module that nobody has imported yet
            import_module(f"{modules[name]}.{name}")
        return getattr(module, name)

    return get, lambda: names, names
