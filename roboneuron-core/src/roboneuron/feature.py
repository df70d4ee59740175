"""What features and commands may use of the core, beside `roboneuron` itself; the rest of it is
private.

Plugins of devices, models and robots need `roboneuron` alone. `feature.pyi` lists the names; some
are modules (`topics`, `roles`, ...), of which all public names may be used. A name is imported when
it is first asked for. They change with minor releases: CHANGELOG.md records it.
"""

import ast
from importlib import import_module
from pathlib import Path

# lazy_loader would keep each name in the package `roboneuron` too, where some mean something else.
_MODULES = {
    alias.name: f"roboneuron.{node.module}" if node.module else "roboneuron"
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for alias in node.names
}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(_MODULES[name])
    if not hasattr(module, name):  # a module that nobody has imported yet
        import_module(f"{_MODULES[name]}.{name}")
    value = globals()[name] = getattr(module, name)
    return value


def __dir__() -> list[str]:
    return __all__
