"""Without a valid certificate, a process neither receives from a machine of the link nor is
received, whichever side connects.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
from link_machines import Machine as Namespace
from link_machines import Talker, impossible, machines
from link_pairs import admit, make_hub, pair

from rn_link.keys import add_peer, make_machine, new_identity, write_private
from rn_link.machine import Machine, Peer
from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
CONNECTING = ("foreign", "none", "plain", "revoked", "member", "udp")
LISTENING = ("foreign", "none", "plain", "revoked")
STRANGERS = (*(f"hub-{kind}" for kind in CONNECTING), *(f"member-{kind}" for kind in LISTENING))


@dataclass(frozen=True)
class Lab:
    """A robot and its GPU machine, another robot, and one machine for each foreign node.

    The other robot is paired with the listening ones, and connects to them.
    """

    robot: Namespace
    gpu: Namespace
    other: Namespace
    strangers: Mapping[str, Namespace]

    def stranger(self, name: str) -> Talker:
        """Start a foreign node: RoboNeuron's ROS, and a relay with the keys and behaviour of its
        kind.
        """
        machine = self.strangers[name]
        if name == "hub-udp":
            return machine.talk(name, link=False, ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET")
        return machine.talk(name, MANNERS=name.partition("-")[2])

    def keep(self, name: str, own: Path, trusted: Path) -> None:
        """Create the link of a foreign node: the key in `own`, and the certificate of the machine
        to be contacted.
        """
        folder = self.strangers[name].link
        is_hub = name.startswith("hub")
        make_machine(folder, Machine(name="x", role="hub" if is_hub else "member"), new_identity())
        for file in ("own.key", "own.pem"):
            write_private(folder / file, (own / file).read_bytes())
        peer = ("gpu", self.gpu) if is_hub else ("other", self.other)
        add_peer(folder, peer[0], Peer(peer[1].address), trusted.read_bytes())


def prepare(lab: Lab, folder: Path) -> None:
    """Pair robot and GPU machine, and create the keys of all foreign nodes."""
    robot = lab.robot
    make_hub(folder / "foreign")
    # the GPU machine was paired with a hub that has had a new key since
    pair(robot, lab.gpu)
    robot.link.rename(folder / "revoked")
    pair(robot, lab.gpu)
    admit(robot.link, folder / "member", "third", Peer("10.1.2.3"))
    for kind in CONNECTING[:-1]:
        own = folder / (kind if kind in ("revoked", "member") else "foreign")
        lab.keep(f"hub-{kind}", own, lab.gpu.link / "own.pem")
    # the other robot connects to each listening foreign node, and has revoked the key of one
    make_hub(lab.other.link, "other")
    for kind in LISTENING:
        name = f"member-{kind}"
        at = Peer(lab.strangers[name].address)
        own = folder / ("was-revoked" if kind == "revoked" else "foreign")
        for member in (folder / f"was-{kind}", folder / f"is-{kind}"):
            admit(lab.other.link, member, name, at, hub_name="other")
        lab.keep(name, own, lab.other.link / "own.pem")


@dataclass(frozen=True)
class Heard:
    """Messages received by every process at the end."""

    strangers: Mapping[str, Talker]
    robot: Talker
    gpu: Talker
    other: Talker

    @property
    def ours(self) -> tuple[Talker, ...]:
        """Processes from which no foreign node may receive anything."""
        return (self.robot, self.gpu, self.other)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("machines")
    with machines(folder, "robot", "gpu", "other", *STRANGERS) as made:
        found = Lab(
            made["robot"], made["gpu"], made["other"], {name: made[name] for name in STRANGERS}
        )
        prepare(found, folder)
        yield found


@pytest.fixture(scope="module")
def heard(lab: Lab) -> Iterator[Heard]:
    strangers = {name: lab.stranger(name) for name in STRANGERS}
    for talker in strangers.values():
        wait_until(lambda talker=talker: talker.heard(talker.name), 60.0, talker.name)
    found = Heard(strangers, lab.robot.talk("robot"), lab.gpu.talk("gpu"), lab.other.talk("other"))
    found.robot.wait_for("gpu", 100, 60.0)
    found.gpu.wait_for("robot", 100, 60.0)
    wait_until(lambda: found.other.heard("other") > 100, 60.0, "time to connect to strangers")
    yield found
    for talker in (*strangers.values(), *found.ours):
        talker.end()


def test_paired_machines_hear_each_other(heard: Heard) -> None:
    assert heard.robot.heard("gpu") >= 100
    assert heard.gpu.heard("robot") >= 100


@pytest.mark.parametrize("name", STRANGERS)
def test_a_stranger_hears_nothing_and_is_not_heard(heard: Heard, name: str) -> None:
    stranger = heard.strangers[name]
    assert stranger.process.poll() is None, stranger.log.read_text()
    assert [stranger.heard(one.name) for one in heard.ours] == [0, 0, 0]
    assert [one.heard(name) for one in heard.ours] == [0, 0, 0]


def test_every_stranger_was_refused_at_a_connection(heard: Heard) -> None:
    """Each has reached the point of the certificate check, and would be connected without it."""
    connected = "".join(talker.log.read_text() for talker in heard.strangers.values())
    assert connected.count("No link to gpu") >= len(CONNECTING) - 1 - ("Linked" in connected)
    refused = heard.other.log.read_text()
    assert [kind for kind in LISTENING if f"No link to member-{kind}" not in refused] == []


def test_strangers_are_heard_where_nobody_asks_for_certificates(lab: Lab, heard: Heard) -> None:
    """What the foreign nodes receive without certificate checks, which shows that the tests can
    fail.
    """
    heard.gpu.end()
    heard.robot.end()
    for name, talker in heard.strangers.items():
        if name != "hub-foreign":
            talker.end()
    careless = lab.gpu.talk("careless", MANNERS="careless")
    wait_until(lambda: careless.heard("careless"), 60.0, careless.log.read_text())
    heard.strangers["hub-foreign"].wait_for("careless", 1, 60.0)
    careless.wait_for("hub-foreign", 1, 60.0)
