"""Fixtures of the interface tests: installed names, value generator, comparison."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def interface_values() -> ModuleType:
    """The module `interface_values.py` beside this file."""
    name = "roboneuron_interface_values"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, HERE / "interface_values.py")
        assert spec is not None
        assert spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]
