"""Imports in the core go in one direction, errors <- contract <- ... <- cli, and name no plugin."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from import_facts import CORE, PLUGINS, imports_of

LIGHT = {"errors", "foreign", "hang_watch", "listing", "log_files"}
CONTRACT = LIGHT | {"contract"}
BELOW_GATE = CONTRACT | {"plugins", "planning", "config"}
NODES = BELOW_GATE | {"gate", "estop", "ros", "modules", "moved"}
SERVER = BELOW_GATE | {
    *("gate", "estop", "ros", "modules", "supervisor", "estop.server", "moved", "server"),
    *("compressed_image", "answering_process"),
}
ALLOWED: dict[str, set[str]] = {
    "errors": set(),
    "foreign": {"errors"},
    "moved": {"errors"},
    **{name: {"listing"} for name in ("feature", "command")},
    "listing": set(),
    **{name: set() for name in ("hang_watch", "log_files")},
    "contract": LIGHT,
    "compressed_image": {"contract", "errors"},
    "answering_process": LIGHT | {"plugins"},
    "plugins": LIGHT,
    "config": LIGHT | {"plugins"},
    "planning": LIGHT | {"plugins", "config"},
    "gate": BELOW_GATE,
    "estop": BELOW_GATE | {"gate"},
    "ros": BELOW_GATE | {"gate"},
    "modules": BELOW_GATE | {"gate", "estop", "ros", "moved"},
    "supervisor": BELOW_GATE | {"gate", "ros", "modules"},
    "estop.server": BELOW_GATE | {"gate", "estop", "ros", "modules", "supervisor"},
    "server": SERVER - {"server"},
    "modules.perception": NODES,
    "modules.control": NODES,
    "modules.inference": NODES,
    "modules.execution": NODES | {"modules.inference"},
    "modules.execution.feature": SERVER | {"modules.execution", "modules.inference"},
    "stdio": SERVER,
    "direct_path": SERVER,
    "sight": SERVER | {"direct_path"},
    "selection": SERVER | {"modules.inference"},
    "tools": set(),
    "tools.loop": SERVER | {"modules.inference", "selection"},
    "tools.arm": SERVER | {"direct_path", "sight"},
    "tools.arm.limits_command": SERVER | {"tools.arm", "cli"},
    "tools.inspect": SERVER | {"selection", "sight", "tools.arm"},
    "tools.ros": SERVER | {"direct_path"},
    "switching": SERVER | {"modules.control", "modules.inference", "selection", "tools.loop"},
}
"""Packages of the core by the packages that they may import (and `log_files`, all of them); `cli`
may import all. A module or a package in another one may have a line of its own.
"""
ROOMS_OF_FILES = {
    "estop.emergency": "estop.server",
    "estop.motion_claims": "estop.server",
    "estop.motion_starts": "estop.server",
    "estop.motion_stop": "estop.server",
    "estop.command": "cli",
}
"""Files that count as part of another package than their folder's."""
ROS_ROOMS = {"ros", "modules", "modules.inference", "direct_path"}
"""Packages that may import rclpy."""
CONTRACT_LIBRARIES = {"numpy"}
PLUGIN_LIBRARIES = {"pluggy", "pydantic"}


def _room(path: Path) -> str:
    return _room_of(path.relative_to(CORE).with_suffix("").parts)


def _room_of(parts: Sequence[str]) -> str:
    """The longest part of a dotted name below `roboneuron` that has a rule, or its first word."""
    names = [".".join(parts[:n]) for n in range(len(parts), 0, -1)]
    found = next((name for name in names if name in ROOMS_OF_FILES or name in ALLOWED), names[-1])
    return ROOMS_OF_FILES.get(found, found)


def _core_files() -> list[Path]:
    return sorted(p for p in CORE.rglob("*.py") if p.parent != CORE or p.name != "__init__.py")


def _breaches(path: Path) -> Iterator[str]:
    room = _room(path)
    allowed = ALLOWED.get(room, set(ALLOWED) | {"cli"}) | {room, "log_files"}
    for name, line in imports_of(path):
        parts = name.split(".")
        if (
            parts[0] == "roboneuron"
            and len(parts) > 1
            and parts[1] != "__version__"
            and _room_of(parts[1:]) not in allowed
        ):
            yield f"{path.relative_to(CORE)}:{line} imports {name}"
        if parts[0] == "rclpy" and room not in ROS_ROOMS:
            yield f"{path.relative_to(CORE)}:{line} imports rclpy"
        if parts[0].startswith("rn_"):
            yield f"{path.relative_to(CORE)}:{line} imports the plugin {name}"


def test_every_room_of_the_core_has_its_rule():
    rooms = {_room(p) for p in _core_files()}
    assert rooms <= {*ALLOWED, "cli"}


def test_imports_in_the_core_point_one_way():
    breaches = [breach for path in _core_files() for breach in _breaches(path)]
    assert not breaches, "\n".join(breaches)


def test_a_breach_of_the_import_rules_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "CORE", tmp_path)
    (tmp_path / "contract").mkdir()
    bad = tmp_path / "contract" / "bad.py"
    bad.write_text("import rclpy\nimport rn_robot_fr3\nfrom roboneuron.server import app\n")
    assert len(list(_breaches(bad))) == 3


@pytest.mark.parametrize(
    ("room", "libraries"), [("contract", CONTRACT_LIBRARIES), ("plugins", PLUGIN_LIBRARIES)]
)
def test_light_rooms_use_few_libraries(room, libraries):
    used = {
        name.split(".")[0]
        for path in (CORE / room).rglob("*.py")
        for name, _ in imports_of(path)
        if name.split(".")[0] not in sys.stdlib_module_names | {"roboneuron"}
    }
    assert used <= libraries


def test_the_core_names_no_installed_plugin_in_code():
    """A distribution's name is allowed in a message to people; elsewhere it would be a
    dependency.
    """
    packages = {
        p.name.replace("-", "_") for p in PLUGINS.iterdir() if (p / "pyproject.toml").exists()
    }
    assert "rn_standard" in packages
    for path in _core_files():
        text = path.read_text(encoding="utf-8")
        assert not [p for p in packages if p in text], path


def _at_import_time(path: Path) -> Iterator[str]:
    """Modules of the core that importing this one imports."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_the_import_graph_of_the_core_has_no_cycle():
    modules = {
        ".".join(["roboneuron", *path.relative_to(CORE).with_suffix("").parts]).removesuffix(
            ".__init__"
        ): path
        for path in CORE.rglob("*.py")
    }
    graph = {
        name: {
            m
            for m in _at_import_time(path)
            if m in modules and m != name and modules[m].name != "__init__.py"
        }
        for name, path in modules.items()
        if path.name != "__init__.py"
    }
    try:
        tuple(graphlib.TopologicalSorter(graph).static_order())
    except graphlib.CycleError as error:
        pytest.fail(f"modules import each other: {' -> '.join(error.args[1])}")


@pytest.mark.parametrize("module", ["roboneuron.plugins.discovery", "roboneuron.cli.main"])
def test_light_modules_import_nothing_heavy(module):
    script = (
        f"import sys, {module}; print([m for m in ('numpy','torch','rclpy','mcp','pydantic') "
        "if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


def test_no_client_waits_for_ros_before_it_is_answered(tmp_path: Path) -> None:
    """A server is assembled, with every plugin, before it joins ROS in the background."""
    script = (
        "import sys\n"
        "from pathlib import Path\n"
        "from roboneuron.config import parse_config\n"
        "from roboneuron.server.app import Application\n"
        f'text = \'[robot]\\nname = "fr3"\\n[supervisor]\\nstate_directory = "{tmp_path}"\'\n'
        "Application(parse_config(text))\n"
        "print(sorted({'mcap_ros2', 'rclpy', 'scipy', 'torch'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


WITH_OPTIONAL = {
    "test_a_topic_of_another_type_here_is_refused_with_both.py",  # the condition of a task
    *("conftest.py", "test_an_admin_exposes_at_run_time.py"),  # clients are notified
    "test_an_arm_that_nobody_leads_rests.py",  # control, led by teleoperation
}
"""Tests of the core's rules for what optional features do."""


def test_the_cores_tests_need_no_other_distribution():
    """They run with the core, the kit and its fakes alone."""
    tests = CORE.parents[1] / "tests"
    foreign = {
        path.name
        for path in tests.rglob("*.py")
        for name, _ in imports_of(path)
        if name.startswith("rn_") and not name.startswith("rn_testing.")
    }
    assert foreign == WITH_OPTIONAL
