"""Imports point one way, errors <- contract <- ... <- cli; core names no plugin; plugins import what is public."""

from __future__ import annotations

import ast
import graphlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import roboneuron
from rn_testing.rules.package import SENDER, importable, is_public

ROOT = Path(__file__).parents[1]
CORE = ROOT / "roboneuron-core" / "src" / "roboneuron"
PLUGINS = ROOT / "plugins"

LIGHT = {"errors", "log_files"}
CONTRACT = LIGHT | {"contract"}
ALLOWED: dict[str, set[str]] = {
    "errors": set(),
    "log_files": set(),
    "contract": LIGHT,
    "plugins": LIGHT,
    "planning": LIGHT | {"plugins"},
    "config": LIGHT | {"plugins"},
    "gate": CONTRACT | {"plugins", "planning", "config"},
    "ros": CONTRACT | {"plugins", "planning", "config", "gate"},
    "modules": CONTRACT | {"plugins", "planning", "config", "gate", "ros"},
    "supervisor": CONTRACT | {"plugins", "planning", "config", "gate", "ros", "modules"},
    "server": CONTRACT | {"plugins", "planning", "config", "gate", "ros", "modules", "supervisor"},
}
"""Rooms of the core by the rooms they may import (and `log_files`, all of them); `cli` may import all."""
ROS_ROOMS = {"ros", "modules"}
"""Where rclpy may be imported."""
SENDING = ("roboneuron.ros.link", "rn_direct_path.writer", "rn_direct_path.traffic")
"""What could send a message past the gate."""
CONTRACT_LIBRARIES = {"numpy"}
PLUGIN_LIBRARIES = {"pluggy", "pydantic"}


def _imports(path: Path) -> Iterator[tuple[str, int]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}:{node.lineno} uses a relative import"
            yield from ((f"{node.module}.{alias.name}", node.lineno) for alias in node.names)


def _room(path: Path) -> str:
    return path.relative_to(CORE).parts[0].removesuffix(".py")


def _core_files() -> list[Path]:
    return sorted(p for p in CORE.rglob("*.py") if p.parent != CORE or p.name != "__init__.py")


def _breaches(path: Path) -> Iterator[str]:
    room = _room(path)
    allowed = ALLOWED.get(room, set(ALLOWED) | {"cli"}) | {room, "log_files"}
    for name, line in _imports(path):
        parts = name.split(".")
        if parts[0] == "roboneuron" and len(parts) > 1 and parts[1] != "__version__" and parts[1] not in allowed:
            yield f"{path.relative_to(CORE)}:{line} imports {name}"
        if parts[0] == "rclpy" and room not in ROS_ROOMS:
            yield f"{path.relative_to(CORE)}:{line} imports rclpy outside ros and modules"
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


@pytest.mark.parametrize(("room", "libraries"), [("contract", CONTRACT_LIBRARIES), ("plugins", PLUGIN_LIBRARIES)])
def test_light_rooms_use_few_libraries(room, libraries):
    used = {
        name.split(".")[0]
        for path in (CORE / room).rglob("*.py")
        for name, _ in _imports(path)
        if name.split(".")[0] not in sys.stdlib_module_names | {"roboneuron"}
    }
    assert used <= libraries


def test_the_core_names_no_installed_plugin_in_code():
    """A distribution's name in a message to people is help; in anything else it would be a dependency."""
    packages = {p.name.replace("-", "_") for p in PLUGINS.iterdir() if (p / "pyproject.toml").exists()}
    for path in _core_files():
        text = path.read_text(encoding="utf-8")
        assert not [p for p in packages if p in text], path


def test_plugins_import_only_what_is_public_of_the_core():
    breaches = []
    for sources in sorted(PLUGINS.glob("*/src")):  # a library offers nothing
        offers = "".join(path.read_text(encoding="utf-8") for path in sources.glob("*/plugin.py"))
        feature, command = "FeatureSpec" in offers, "CommandSpec" in offers
        packages = importable(feature=feature, command=command, sender=sources.parent.name == SENDER)
        breaches += [
            f"{path.relative_to(PLUGINS)}:{line} imports {name}"
            for path in sorted(sources.rglob("*.py"))
            for name, line in _imports(path)
            if not is_public(name, packages)
        ]
    assert breaches == []


def _reaches_ros(path: Path) -> Iterator[str]:
    """What only the core and the direct path do in the server's process: publishing, making nodes and clients."""
    for name, line in _imports(path):
        if name.split(".")[0] == "rclpy" or name.startswith(SENDING):
            yield f"{path.name}:{line} imports {name}"
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute) and node.attr in {"create_publisher", "create_client", "advertise", "link"}:
            yield f"{path.name}:{node.lineno} uses .{node.attr}"


def test_features_send_only_through_the_gate():
    """No publisher, client or node beside `host.gate`; a command is a process of its own and may join the graph."""
    breaches = []
    for plugin in sorted(PLUGINS.glob("*/src/*/plugin.py")):
        text = plugin.read_text(encoding="utf-8")
        if "FeatureSpec" in text and plugin.parents[2].name != SENDER:
            # A robot's package has drivers too, which run in a module and are lent topics: there only what runs here.
            names = sorted(set(re.findall(r'target="[\w.]+\.(\w+):\w+Feature"', text)))
            paths = [plugin.parent / f"{n}.py" for n in names] if "RobotSpec" in text else plugin.parent.rglob("*.py")
            breaches += [breach for path in sorted(paths) for breach in _reaches_ros(path)]
    assert breaches == []


def test_one_distribution_sends_for_agents_and_one_of_its_modules_publishes():
    sources = PLUGINS / SENDER / "src" / SENDER.replace("-", "_")
    publishing = {path.name for path in sources.rglob("*.py") if "create_publisher" in path.read_text(encoding="utf-8")}
    assert publishing == {"writer.py"}
    assert [breach for path in sources.rglob("*.py") for breach in _reaches_ros(path)]


def test_a_feature_that_publishes_beside_the_gate_is_seen(tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text(
        "import rclpy\nfrom roboneuron.ros.link import RosLink\nhost.supervisor.link.advertise(Bool, 't', 1)\n"
        "from rn_direct_path.writer import TopicWriter\nfrom rn_direct_path import traffic\n"
    )
    assert len(list(_reaches_ros(bad))) == 6


def test_plugins_import_the_contract_kit_only_where_their_descriptors_name_a_case():
    breaches = []
    for plugin in sorted(set(PLUGINS.glob("*/src/*/plugin.py")) - set(PLUGINS.glob("rn-testing/src/*/plugin.py"))):
        sources = sorted(plugin.parent.rglob("*.py"))
        importing = {p for p in sources if any(name.split(".")[0] == "rn_testing" for name, _ in _imports(p))}
        named = plugin.read_text(encoding="utf-8")
        breaches += [
            f"{path.relative_to(PLUGINS)} imports rn_testing and is no `case`"
            for path in importing
            if f'"{".".join(path.relative_to(plugin.parents[1]).with_suffix("").parts)}:' not in named
        ]
    assert breaches == []


def test_device_and_model_plugins_take_public_names_from_the_public_api():
    """`from roboneuron import Frame`, so that a module of the core can be moved without breaking a plugin."""
    roundabout = []
    for package in sorted(path.parent for path in PLUGINS.glob("*/src/*/__init__.py")):
        plugin = package / "plugin.py"
        offers = plugin.read_text(encoding="utf-8") if plugin.exists() else ""
        if "FeatureSpec" in offers or "CommandSpec" in offers:
            continue
        roundabout += [
            f"{path.relative_to(PLUGINS)}:{node.lineno} imports {alias.name} from {node.module}"
            for path in sorted(package.rglob("*.py"))
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("roboneuron.")
            for alias in node.names
            if alias.name in roboneuron.__all__ and alias.asname is None
        ]
    assert roundabout == []


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
        ".".join(["roboneuron", *path.relative_to(CORE).with_suffix("").parts]).removesuffix(".__init__"): path
        for path in CORE.rglob("*.py")
    }
    graph = {
        name: {m for m in _at_import_time(path) if m in modules and m != name and modules[m].name != "__init__.py"}
        for name, path in modules.items()
        if path.name != "__init__.py"
    }
    try:
        tuple(graphlib.TopologicalSorter(graph).static_order())
    except graphlib.CycleError as error:
        pytest.fail(f"modules import each other: {' -> '.join(error.args[1])}")


@pytest.mark.parametrize("module", ["roboneuron.plugins.discovery", "roboneuron.planning", "roboneuron.cli.main"])
def test_light_modules_import_nothing_heavy(module):
    script = f"import sys, {module}; print([m for m in ('numpy','torch','rclpy','mcp','pydantic') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
