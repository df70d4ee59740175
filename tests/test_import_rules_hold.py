"""Imports point one way, errors <- contract <- ... <- cli; core names no plugin; plugins import
what is public.
"""

from __future__ import annotations

import ast
import functools
import graphlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

from rn_testing.distribution import LISTS, imported_modules
from rn_testing.rules.package import KIT, SENDER, is_public, lists_for

ROOT = Path(__file__).parents[1]
CORE = ROOT / "roboneuron-core" / "src" / "roboneuron"
PLUGINS = ROOT / "plugins"

LIGHT = {"errors", "listing", "log_files"}
CONTRACT = LIGHT | {"contract"}
BELOW_GATE = CONTRACT | {"plugins", "planning", "config"}
ALLOWED: dict[str, set[str]] = {
    "errors": set(),
    **{name: {"listing"} for name in ("feature", "command", "node")},
    "listing": set(),
    "log_files": set(),
    "contract": LIGHT,
    "plugins": LIGHT,
    "planning": LIGHT | {"plugins"},
    "config": LIGHT | {"plugins"},
    "gate": BELOW_GATE,
    "estop": BELOW_GATE | {"gate"},
    "ros": BELOW_GATE | {"gate"},
    "modules": BELOW_GATE | {"gate", "estop", "ros"},
    "supervisor": BELOW_GATE | {"gate", "ros", "modules"},
    "estop.server": BELOW_GATE | {"gate", "estop", "ros", "modules", "supervisor"},
    "server": BELOW_GATE | {"gate", "estop", "ros", "modules", "supervisor", "estop.server"},
}
"""Rooms of the core by the rooms they may import (and `log_files`, all of them); `cli` may import
all.
"""
ROOMS_OF_FILES = {
    "estop.emergency": "estop.server",
    "estop.motion_starts": "estop.server",
    "estop.command": "cli",
}
"""Files that belong to another room than the folder they lie in."""
ROS_ROOMS = {"ros", "modules"}
"""Where rclpy may be imported."""
SENDING = (
    *("roboneuron.ros.link", "roboneuron.feature.RosLink", "roboneuron.command.RosLink"),
    *("rn_standard.direct_path.writer", "rn_standard.direct_path.traffic"),
)
"""What could send a message past the gate."""
CONTRACT_LIBRARIES = {"numpy"}
PLUGIN_LIBRARIES = {"pluggy", "pydantic"}
PROGRAMS = ("lerobot_robot_roboneuron", "lerobot_teleoperator_roboneuron")
"""Packages that run in a program that a person starts, as commands do: they join the graph
themselves, and what they send passes control's limits and stops.
"""
STANDARD = PLUGINS / "rn-standard" / "src" / "rn_standard"
"""Packages of its own, each a plugin, in one distribution."""
COMMANDS_APART = {"doctor": "ops", "limits": "tools_arm"}
"""Packages of rn_standard without a plugin module, by the plugin that their command belongs to."""
NEEDS = {
    "console": {"selection"},
    "demo": {"console"},
    "execution": {"inference"},
    "limits": {"tools_arm"},
    "ops": {"tools_loop"},
    "switching": {"inference", "selection", "tools_loop"},
    "tasks": {"direct_path", "selection", "tools_loop"},
    "tools_arm": {"direct_path"},
    "tools_ros": {"direct_path"},
}
"""Packages of rn_standard by those beside them that they may import."""
PUBLISHED = {
    "console": "chosen_plugins client diagnostics plugin_options status",
    "direct_path": "allow_list arbiter delivery derived exposed fields joints limits speeds twists "
    "type_hashes",
    "execution": "adaptive mode",
    "http": "addresses authentication bounded_server connections feature listener operator_lease "
    "options origins plugin tokens",
    "inference": "agreement execution module",
    "selection": "choosing options requests restricted",
    "tasks": "contract_cases hooks monitor",
    "tools_arm": "tightening",
    "tools_loop": "instructing results",
    "tools_ros": "interfaces",
}
"""Modules of these packages that others may import."""


@functools.cache
def _imports(path: Path) -> list[tuple[str, int]]:
    """Names that a file imports, with lines; many tests here ask for those of every file."""
    found: list[tuple[str, int]] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}:{node.lineno} uses a relative import"
            found += [(f"{node.module}.{alias.name}", node.lineno) for alias in node.names]
    return found


def _room(path: Path) -> str:
    parts = path.relative_to(CORE).with_suffix("").parts
    return ROOMS_OF_FILES.get(".".join(parts[:2]), parts[0])


def _core_files() -> list[Path]:
    return sorted(p for p in CORE.rglob("*.py") if p.parent != CORE or p.name != "__init__.py")


def _breaches(path: Path) -> Iterator[str]:
    room = _room(path)
    allowed = ALLOWED.get(room, set(ALLOWED) | {"cli"}) | {room, "log_files"}
    for name, line in _imports(path):
        parts = name.split(".")
        if (
            parts[0] == "roboneuron"
            and len(parts) > 1
            and parts[1] != "__version__"
            and ROOMS_OF_FILES.get(".".join(parts[1:3]), parts[1]) not in allowed
        ):
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


@pytest.mark.parametrize(
    ("room", "libraries"), [("contract", CONTRACT_LIBRARIES), ("plugins", PLUGIN_LIBRARIES)]
)
def test_light_rooms_use_few_libraries(room, libraries):
    used = {
        name.split(".")[0]
        for path in (CORE / room).rglob("*.py")
        for name, _ in _imports(path)
        if name.split(".")[0] not in sys.stdlib_module_names | {"roboneuron"}
    }
    assert used <= libraries


def test_the_core_names_no_installed_plugin_in_code():
    """A distribution's name in a message to people is help; in anything else it would be a
    dependency.
    """
    packages = {
        p.name.replace("-", "_") for p in PLUGINS.iterdir() if (p / "pyproject.toml").exists()
    }
    assert "rn_standard" in packages
    for path in _core_files():
        text = path.read_text(encoding="utf-8")
        assert not [p for p in packages if p in text], path


def _plugins() -> Iterator[tuple[str, tuple[Path, ...]]]:
    """Each plugin or library by name, with its packages: all of a distribution, in rn-standard each
    by itself.
    """
    for sources in sorted(PLUGINS.glob("*/src")):
        if sources != STANDARD.parent:
            yield (
                sources.parent.name,
                tuple(sorted(path.parent for path in sources.glob("*/__init__.py"))),
            )
    for package in sorted(path.parent for path in STANDARD.glob("*/__init__.py")):
        if package.name not in COMMANDS_APART:
            apart = [
                STANDARD / name for name, owner in COMMANDS_APART.items() if owner == package.name
            ]
            yield f"rn-standard/{package.name}", (package, *apart)


def _offers(packages: Iterable[Path]) -> str:
    """Text of the plugin modules; a library has none."""
    modules = [package / "plugin.py" for package in packages]
    return "".join(path.read_text(encoding="utf-8") for path in modules if path.exists())


SENDING_PACKAGE = STANDARD / "direct_path"


def _private_imports(packages: Iterable[Path]) -> Iterator[str]:
    """What a plugin imports of the core beside `roboneuron` and the lists for what it offers."""
    packages = tuple(packages)
    offers = _offers(packages)
    lists = lists_for(
        features="FeatureSpec" in offers,
        commands="CommandSpec" in offers or {path.name for path in packages} <= {*PROGRAMS},
        is_kit=PLUGINS / KIT in next(iter(packages)).parents,
    )
    for path in sorted(path for package in packages for path in package.rglob("*.py")):
        for name, line in imported_modules(path):
            if not is_public(name, lists, sends=SENDING_PACKAGE in packages):
                yield f"{path.relative_to(PLUGINS)}:{line} imports {name}"


def test_plugins_import_only_what_is_public_of_the_core():
    assert [breach for _, packages in _plugins() for breach in _private_imports(packages)] == []


MOST_NAMES = {"roboneuron.feature": 80, "roboneuron.command": 68, "roboneuron.node": 33}
"""For code in the server, for commands and for code in modules; these only go down."""


def _offered(of: str) -> set[str]:
    """Single names, and each name of a module: a module counts as all that may be used of it."""
    groups = LISTS[of].GROUPS
    return (set(LISTS[of].__all__) - groups.keys()) | {
        f"{group}.{name}" for group, names in groups.items() for name in names
    }


@pytest.mark.parametrize("of", LISTS)
def test_every_listed_name_is_used_by_a_plugin_and_they_stay_few(of):
    used = {
        name.removeprefix(f"{of}.")
        for path in PLUGINS.glob("*/src/**/*.py")
        for name, _ in imported_modules(path)
        if name.startswith(f"{of}.")
    }
    assert used - LISTS[of].GROUPS.keys() == _offered(of)
    assert len(_offered(of)) <= MOST_NAMES[of]


@pytest.mark.parametrize("of", LISTS)
def test_every_name_of_a_listed_module_is_there(of):
    listed = LISTS[of]
    assert listed.GROUPS.keys() == {
        name for name in listed.__all__ if isinstance(getattr(listed, name), ModuleType)
    }
    for group, names in listed.GROUPS.items():
        assert {n for n in names if not hasattr(getattr(listed, group), n)} == set()


@pytest.mark.parametrize(
    ("offers", "line", "is_seen"),
    [
        ("BackendSpec", "from roboneuron import Frame", False),
        ("BackendSpec", "from roboneuron.contract import Frame", True),
        ("BackendSpec", "from roboneuron.feature import Config", True),
        ("FeatureSpec", "from roboneuron.feature import Config", False),
        ("FeatureSpec", "from roboneuron.feature import RosLink", True),
        ("FeatureSpec", "from roboneuron.feature import Supervisor", True),
        ("FeatureSpec", "from roboneuron.feature import topics\ntopics.ACTION", False),
        ("FeatureSpec", "from roboneuron.feature import topics as t\nt.anything", True),
        ("FeatureSpec", "from roboneuron.command import RosLink", True),
        ("FeatureSpec", "from roboneuron.node import ModuleHost", False),
        ("CommandSpec", "from roboneuron.command import RosLink", False),
        ("CommandSpec", "from roboneuron.feature import Config", True),
        ("FeatureSpec", "from roboneuron.config import Config", True),
        ("CommandSpec", "import roboneuron.server.app", True),
    ],
)
def test_an_import_of_what_is_private_is_seen(tmp_path, monkeypatch, offers, line, is_seen):
    monkeypatch.setattr(sys.modules[__name__], "PLUGINS", tmp_path)
    (tmp_path / "plugin.py").write_text(f"from roboneuron import {offers}\n")
    (tmp_path / "bad.py").write_text(f"{line}\n")
    assert bool(list(_private_imports([tmp_path]))) is is_seen


def _breaches_among_features(path: Path) -> Iterator[str]:
    """What a file imports of another package of rn_standard than its own, and may not."""
    inside = path.relative_to(PLUGINS).parts
    own = inside[3] if path.is_relative_to(STANDARD) else ""
    for name, line in _imports(path):
        top, package, module, *_ = [*name.split("."), "", ""]
        if top != "rn_standard" or package == own:
            continue
        if own and package not in NEEDS.get(own, ()):
            yield (
                f"{path.relative_to(PLUGINS)}:{line} imports {name}: {own} does not need {package}"
            )
        elif module not in PUBLISHED.get(package, "").split():
            yield (
                f"{path.relative_to(PLUGINS)}:{line} imports {name}, which {package} does not "
                "publish"
            )


def test_features_import_of_each_other_only_what_is_published():
    breaches = [
        breach
        for path in sorted(PLUGINS.glob("*/src/**/*.py"))
        for breach in _breaches_among_features(path)
    ]
    assert breaches == []


def test_a_feature_that_reaches_into_another_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "PLUGINS", tmp_path)
    monkeypatch.setattr(
        sys.modules[__name__], "STANDARD", tmp_path / "rn-standard" / "src" / "rn_standard"
    )
    bad = tmp_path / "rn-standard" / "src" / "rn_standard" / "tasks" / "bad.py"
    bad.parent.mkdir(parents=True)
    bad.write_text(
        "from rn_standard.selection.requests import x\n"  # as it should be
        "from rn_standard.selection.permission import x\nfrom rn_standard.ops.restarts import x\n"
        "import rn_standard.http\n"
    )
    elsewhere = tmp_path / "rn-eval" / "src" / "rn_eval" / "bad.py"
    elsewhere.parent.mkdir(parents=True)
    elsewhere.write_text(
        "from rn_standard.execution.mode import x\nfrom rn_standard.execution.queue import x\n"
    )
    assert len(list(_breaches_among_features(bad))) == 3
    assert len(list(_breaches_among_features(elsewhere))) == 1


def test_the_tables_name_packages_and_modules_that_are_there():
    named = {
        *NEEDS,
        *PUBLISHED,
        *COMMANDS_APART,
        *(name for needed in NEEDS.values() for name in needed),
    }
    assert {name for name in named if not (STANDARD / name / "__init__.py").exists()} == set()
    modules = [
        STANDARD / package / name for package, names in PUBLISHED.items() for name in names.split()
    ]
    assert [
        m for m in modules if not (m.with_suffix(".py").exists() or (m / "__init__.py").exists())
    ] == []


def _reaches_ros(path: Path) -> Iterator[str]:
    """What only the core and the direct path do in the server's process: publishing, making nodes
    and clients.
    """
    for name, line in _imports(path):
        if name.split(".")[0] == "rclpy" or name.startswith(SENDING):
            yield f"{path.name}:{line} imports {name}"
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Attribute) and node.attr in {
            "create_publisher",
            "create_client",
            "advertise",
            "link",
        }:
            yield f"{path.name}:{node.lineno} uses .{node.attr}"


def test_features_send_only_through_the_gate():
    """No publisher, client or node beside `host.gate`; a command is a process of its own and may
    join the graph.
    """
    breaches = []
    looked_at = set()
    for plugin in sorted(PLUGINS.glob("*/src/**/plugin.py")):
        text = plugin.read_text(encoding="utf-8")
        if "FeatureSpec" in text and plugin.parent != SENDING_PACKAGE:
            # A robot's package has drivers too, which run in a module and are lent topics: there
            # only what runs here.
            names = sorted(set(re.findall(r'target="[\w.]+\.(\w+):\w+Feature"', text)))
            paths = (
                [plugin.parent / f"{n}.py" for n in names]
                if "RobotSpec" in text
                else plugin.parent.rglob("*.py")
            )
            in_modules = set(re.findall(r'module="[\w.]+\.(\w+):\w+"', text))
            breaches += [
                breach
                for path in sorted(paths)
                if path.stem not in in_modules and path not in IN_MODULES
                for breach in _reaches_ros(path)
            ]
            looked_at.add(plugin.parent.name)
    assert breaches == []
    assert {"tools_ros", "tools_arm", "tasks", "ops", "http", "rn_recorder", "rn_view"} <= looked_at


IN_MODULES = {STANDARD / "inference" / "polled.py"}
"""What a class of modules uses beside its own file, and nothing in the server does."""


SUPERVISOR = {"supervisor", "_supervisor", "Supervisor"}


def _uses_of_the_supervisor(path: Path) -> Iterator[str]:
    """Where a file names the supervisor; `[supervisor]` is a section of the configuration too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        match node:
            case ast.Attribute(attr=name, value=owner):
                is_section = re.search(r"(^|\.|_)config(\(.*\))?$", ast.unparse(owner))
                names = set() if is_section else {name}
            case ast.Name(id=name) | ast.arg(arg=name) | ast.keyword(arg=str(name)):
                names = {name}
            case ast.alias(name=name, asname=other):
                names = {name.rpartition(".")[2], other}
            case _:
                continue
        if names & SUPERVISOR:
            yield f"{path.name}:{node.lineno} uses the supervisor"


def test_no_plugin_uses_the_supervisor():
    """Features have `Host.modules` and the requests of `Host.loop`; the node is lent by
    `Host.link`.
    """
    paths = sorted(PLUGINS.glob("*/src/**/*.py"))
    assert [use for path in paths for use in _uses_of_the_supervisor(path)] == []
    assert "Supervisor" not in LISTS["roboneuron.feature"].__all__


@pytest.mark.parametrize(
    ("line", "is_seen"),
    [
        ("host.loop.supervisor.stop('robot')", True),
        ("host.loop._supervisor", True),
        ("Application(config, supervisor=made)", True),
        ("from roboneuron.feature import Supervisor", True),
        ("def switch(supervisor): ...", True),
        ("host.config.supervisor.state_directory", False),
        ("load_config(path).supervisor.state_directory", False),
    ],
)
def test_a_use_of_the_supervisor_is_seen(tmp_path, line, is_seen):
    path = tmp_path / "feature.py"
    path.write_text(f"{line}\n")
    assert bool(list(_uses_of_the_supervisor(path))) is is_seen


def test_the_node_is_lent_to_the_feature_of_the_gate_alone():
    """`Host.link` asks who wants it."""
    from roboneuron.errors import StateError
    from roboneuron.server.feature import Feature
    from roboneuron.server.host import Host

    host = Host(**dict.fromkeys(Host.__dataclass_fields__))
    with pytest.raises(StateError, match="gate"):
        host.link(Feature(None))


def test_one_plugin_sends_for_agents_and_one_of_its_modules_publishes():
    sources = sorted(SENDING_PACKAGE.rglob("*.py"))
    publishing = {
        path.name for path in sources if "create_publisher" in path.read_text(encoding="utf-8")
    }
    assert publishing == {"writer.py"}
    assert [breach for path in sources for breach in _reaches_ros(path)]
    points = tomllib.loads((PLUGINS / SENDER[0] / "pyproject.toml").read_text())["project"][
        "entry-points"
    ]
    assert points["roboneuron"][SENDER[1]] == "rn_standard.direct_path.plugin"


def test_a_feature_that_publishes_beside_the_gate_is_seen(tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text(
        "import rclpy\nfrom roboneuron.ros.link import "
        "RosLink\nhost.loop.supervisor.link.advertise(Bool, 't', 1)\n"
        "from rn_standard.direct_path.writer import TopicWriter\nfrom rn_standard.direct_path "
        "import traffic\n"
    )
    assert len(list(_reaches_ros(bad))) == 6


def test_plugins_import_the_contract_kit_only_where_their_descriptors_name_a_case():
    breaches = []
    for plugin in sorted(
        set(PLUGINS.glob("*/src/**/plugin.py")) - set(PLUGINS.glob("rn-testing/src/*/plugin.py"))
    ):
        sources = sorted(plugin.parent.rglob("*.py"))
        root = next(path for path in plugin.parents if path.name == "src")
        importing = {
            p for p in sources if any(name.split(".")[0] == "rn_testing" for name, _ in _imports(p))
        }
        named = plugin.read_text(encoding="utf-8")
        breaches += [
            f"{path.relative_to(PLUGINS)} imports rn_testing and is no `case`"
            for path in importing
            if f'"{".".join(path.relative_to(root).with_suffix("").parts)}:' not in named
        ]
    assert breaches == []


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


@pytest.mark.parametrize(
    "module", ["roboneuron.plugins.discovery", "roboneuron.planning", "roboneuron.cli.main"]
)
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
    """A server is put together, with every plugin, before it joins ROS in the background."""
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
