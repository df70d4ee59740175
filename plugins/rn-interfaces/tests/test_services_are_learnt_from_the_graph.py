"""Services and actions of nodes in other processes: found where those processes have them, taken
only when all hashes that the nodes announce come out.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from made_packages import WELD, write_package

from rn_interfaces import cache, graph, learning
from rn_interfaces.finder import PREFIXES
from rn_interfaces.graph import hashes_here, uses
from rn_interfaces.learning import learn
from rn_interfaces.sources import definitions
from rn_interfaces.store import DefinitionStore, Name
from rn_interfaces_learning.nodes import NodeGraph, ask_nodes
from rn_testing.domain import free_ros_domain
from rn_testing.waiting import wait_for_line, wait_until
from roboneuron.ros.environment import prepare_environment
from roboneuron.ros.link import RosLink

pytestmark = [pytest.mark.ros, pytest.mark.timeout(180)]
STRIKE = Name("weld_msgs", "srv", "Strike")
WELDING = Name("weld_msgs", "action", "Weld")
WAIT_S = 60.0
"""For what another process does, on a machine that does much else."""


@pytest.fixture
def nodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[NodeGraph]:
    """The graph of a domain that nobody else uses."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    prepare_environment(tmp_path / "log")
    link = RosLink("roboneuron_asks")
    link.open()
    yield NodeGraph(link)
    link.close()


@contextmanager
def serving(nodes: NodeGraph, data: Path, *words: str, prefix: str) -> Iterator[None]:
    """A process that serves, until its endpoints are discovered."""
    environment = {**os.environ, "XDG_DATA_HOME": str(data), PREFIXES: prefix}
    command = [sys.executable, str(Path(__file__).with_name("serving_node.py")), *words]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        try:
            wait_for_line(process.stdout, "there")
            services = ["/served", "/run/_action/send_goal", "/run/_action/get_result"]
            for service in services:
                wait_until(lambda s=service: all(nodes.service_endpoints(s)), WAIT_S)
            wait_until(lambda: len(nodes.endpoints("/run/_action/feedback")) == 1, WAIT_S)
            yield
        finally:
            process.terminate()
            try:
                process.wait(WAIT_S)
            except subprocess.TimeoutExpired:
                process.kill()


@pytest.fixture
def welder(nodes: NodeGraph, empty: DefinitionStore, tmp_path: Path) -> Iterator[NodeGraph]:
    """Beside a node whose process has `weld_msgs` in a prefix of its own."""
    data = tmp_path / "theirs"
    other = DefinitionStore(data / "roboneuron" / "interfaces")
    learn(other, definitions(write_package(tmp_path / "src", "weld_msgs", WELD)))
    prefix = f"{sys.prefix}:{other.prefix}"
    with serving(nodes, data, "weld_msgs", "Strike", "Weld", prefix=prefix):
        yield nodes


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DefinitionStore:
    """A store of somebody who does not have this user's."""
    monkeypatch.setenv(PREFIXES, sys.prefix)
    return DefinitionStore(tmp_path / "empty")


def test_a_service_and_an_action_come_from_where_their_process_has_them(
    welder: NodeGraph, store: DefinitionStore, empty: DefinitionStore
) -> None:
    found = ask_nodes(welder, empty)
    assert not found.refused
    learnt = learn(empty, found)
    assert not learnt.refused
    assert {STRIKE, WELDING, Name("weld_msgs", "msg", "Seam")} == set(learnt.added)
    for name in (STRIKE, WELDING):
        assert hashes_here(empty, name) == hashes_here(store, name)
        assert empty.text(name) == store.text(name)
    again = ask_nodes(welder, empty)
    assert not again.texts, "all of it is known"


@pytest.mark.exhaustive
def test_another_definition_of_the_same_name_is_not_taken(
    welder: NodeGraph, empty: DefinitionStore, tmp_path: Path
) -> None:
    decoy = DefinitionStore(tmp_path / "decoy")
    changed = {
        **WELD,
        "srv/Strike.srv": WELD["srv/Strike.srv"] + "int32 added\n",
        "action/Weld.action": WELD["action/Weld.action"] + "int32 added\n",
    }
    learn(decoy, definitions(write_package(tmp_path / "changed", "weld_msgs", changed)))
    found = ask_nodes(welder, empty, lambda: [tmp_path, decoy.prefix])
    assert not found.texts
    assert found.refused.keys() == {str(STRIKE), str(WELDING)}
    assert "Copy the folder share/weld_msgs" in found.refused[str(STRIKE)].instead
    known = ask_nodes(welder, decoy, list)
    assert known.refused.keys() == {str(STRIKE), str(WELDING)}, "it speaks another one"


def test_compiled_services_and_actions_of_another_process_are_learnt(
    nodes: NodeGraph, empty: DefinitionStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if nobody had compiled test_msgs here."""
    compiled = {
        name: hashes_here(empty, name)
        for name in (
            Name("test_msgs", "srv", "Arrays"),
            Name("test_msgs", "action", "NestedMessage"),
        )
    }
    real = cache.installed

    def hidden(package: str, besides: Path) -> Path | None:
        return None if package == "test_msgs" else real(package, besides)

    for module in (cache, graph, learning):
        monkeypatch.setattr(module, "installed", hidden)
    words = ("test_msgs", "Arrays", "NestedMessage")
    with serving(nodes, tmp_path / "theirs", *words, prefix=sys.prefix):
        assert compiled.keys() <= uses(nodes).keys()
        found = ask_nodes(nodes, empty)
    learnt = learn(empty, found)
    assert not learnt.refused
    assert {name: hashes_here(empty, name) for name in compiled} == compiled
