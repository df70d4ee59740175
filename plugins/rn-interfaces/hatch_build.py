"""Build hook of the wheel: compiles native.c with the machine's C compiler."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PACKAGE = Path(__file__).resolve().parent / "src" / "rn_interfaces"


def _library() -> ModuleType:
    """The module that compiles, by its path: the distribution is not installed yet."""
    spec = importlib.util.spec_from_file_location("_library", PACKAGE / "library.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class CustomBuildHook(BuildHookInterface):  # type: ignore[type-arg]
    """Puts the compiled library into the wheel, which then suits any Python 3 of its platform."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, unless the wheel is an editable one: a checkout compiles what it runs."""
        if version == "editable":
            return
        library = _library()
        self._scratch = TemporaryDirectory()
        made = Path(self._scratch.name, library.SHIPPED.name)
        try:
            library.compile_library(library.SOURCE, made)
            platform = library.wheel_platform(made)
        except library.LibraryError as error:
            raise SystemExit(f"rn-interfaces: {error}") from error
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform}"  # it does not use the Python API
        build_data["force_include"][str(made)] = f"rn_interfaces/{made.name}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was compiled."""
        if version != "editable":
            self._scratch.cleanup()
