"""In the server, only the core and the gate's feature can send, start or stop."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from import_facts import CORE, PLUGINS, SENDING_PACKAGE, STANDARD, imports_of

from rn_testing.distribution import LISTS

SENDING = (
    *("roboneuron.ros.link", "roboneuron.command.RosLink"),
    *("roboneuron.direct_path.writer", "roboneuron.direct_path.traffic"),
)
"""Names with which a message could be sent around the gate."""


def _reaches_ros(path: Path) -> Iterator[str]:
    """Operations that only the core and the direct path may do in the server's process: publishing,
    creating nodes and clients.
    """
    for name, line in imports_of(path):
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
    """No publisher, client or node except through `host.gate`; a command is a separate process and
    may join the graph.
    """
    breaches = []
    looked_at = set()
    for plugin in sorted([*PLUGINS.glob("*/src/**/plugin.py"), *CORE.rglob("plugin.py")]):
        text = plugin.read_text(encoding="utf-8")
        if "FeatureSpec" in text and plugin.parent != SENDING_PACKAGE:
            # A robot's package also has drivers, which run in a module with lent topics; only code
            # of the server counts.
            names = sorted(set(re.findall(r'target="[\w.]+\.(\w+):\w+Feature"', text)))
            paths = (
                [plugin.parent / f"{n}.py" for n in names]
                if "RobotSpec" in text
                else plugin.parent.rglob("*.py")
            )
            # a feature may have a package beside that of its plugin
            features = re.findall(r'FeatureSpec\([^)]*?target="(\w+)\.', text)
            beside = {*features} - {plugin.parts[-2]}
            paths = [
                *paths,
                *(p for name in beside for p in plugin.parents[1].glob(f"{name}/**/*.py")),
            ]
            in_modules = set(re.findall(r'module="[\w.]+\.(\w+):\w+"', text))
            breaches += [
                breach
                for path in sorted(paths)
                if path.stem not in in_modules and path not in IN_MODULES | IN_COMMANDS
                for breach in _reaches_ros(path)
            ]
            looked_at.add(plugin.parent.name)
    assert breaches == []
    assert {"ros", "arm", "tasks", "ops", "http", "rn_recorder", "rn_view"} <= looked_at


IN_MODULES = {
    PLUGINS / "rn-eval" / "src" / "rn_eval_stepped" / "actions.py",
    CORE / "modules" / "inference" / "polled.py",
    STANDARD / "teleoperation" / "in_control.py",
}
"""Names that a module class uses from other files, and that nothing in the server uses."""
IN_COMMANDS = {PLUGINS / "rn-eval" / "src" / "rn_eval" / "agents" / "witness.py"}
"""Likewise, in processes of a command."""


SUPERVISOR = {"supervisor", "_supervisor", "Supervisor"}


def _uses_of_the_supervisor(path: Path) -> Iterator[str]:
    """Lines of a file that name the supervisor; `[supervisor]` is also a section of the
    configuration.
    """
    text = path.read_text(encoding="utf-8")
    # to parse all files takes seconds
    for node in ast.walk(ast.parse(text)) if "upervisor" in text else ():
        match node:
            case ast.Attribute(attr=name, value=owner) if name in SUPERVISOR:
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
    """`Host.link` checks who requests it."""
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


def test_a_feature_that_publishes_beside_the_gate_is_seen(tmp_path):
    bad = tmp_path / "bad.py"
    bad.write_text(
        "import rclpy\nfrom roboneuron.ros.link import "
        "RosLink\nhost.loop.supervisor.link.advertise(Bool, 't', 1)\n"
        "from roboneuron.direct_path.writer import TopicWriter\nfrom roboneuron.direct_path "
        "import traffic\n"
    )
    assert len(list(_reaches_ros(bad))) == 6
