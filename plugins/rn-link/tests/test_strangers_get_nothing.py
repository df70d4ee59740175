"""Nobody without a valid certificate hears a machine of the link or is heard, whoever connects."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from link_machines import Machine as Namespace
from link_machines import Talker, impossible, machines
from link_pairs import admit, pair

from rn_link.certificates import (
    Issuer,
    issue,
    key_to_pem,
    new_key,
    read_certificate,
    read_key,
    to_pem,
    write_private,
)
from rn_link.machine import PORT, Machine, Peer
from rn_link.profile import fast_dds_profile
from rn_link_pairing.keeping import become_hub
from rn_testing.waiting import wait_until

pytestmark = [
    pytest.mark.ros,
    pytest.mark.slow,
    pytest.mark.skipif(bool(impossible()), reason=impossible() or "possible"),
]
CONNECTING = ("foreign", "none", "plain", "expired", "revoked", "member", "udp")
LISTENING = ("foreign", "none", "plain", "expired", "revoked")
Edit = Callable[[str], str]


def without_certificate(profile: str) -> str:
    return re.sub(r"<(cert_chain_file|private_key_file)>.*?</\1>", "", profile)


def without_tls(profile: str) -> str:
    return re.sub(r"<tls>.*?</tls>", "", profile, flags=re.DOTALL)


def as_it_is(profile: str) -> str:
    return profile


EDITS: Mapping[str, Edit] = {"none": without_certificate, "plain": without_tls}


@dataclass(frozen=True)
class Lab:
    """A robot and its GPU machine, another robot, and a third machine with all strangers.

    The other robot connects to strangers alone: one that it refuses keeps it from reaching others.
    """

    robot: Namespace
    gpu: Namespace
    other: Namespace
    third: Namespace

    def stranger(self, role: str, kind: str, number: int = 0) -> Talker:
        """Start a stranger of that kind, on the third machine.

        Args:
            role: "hub" connects to the GPU machine; "member" listens where the robot connects.
        """
        name = f"{role}-{kind}"
        if kind == "udp":
            return self.third.talk(name, link=False, ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET")
        folder = self.third.state / name
        machine = Machine(
            name="stranger",
            role="hub" if role == "hub" else "member",
            port=PORT + number,
            peers={"gpu": Peer(self.gpu.address)},
        )
        profile = EDITS.get(kind, as_it_is)(fast_dds_profile(machine, folder))
        (folder / "stranger.xml").write_text(profile)
        return self.third.talk(
            name,
            link=False,
            FASTRTPS_DEFAULT_PROFILES_FILE=str(folder / "stranger.xml"),
            ROS_AUTOMATIC_DISCOVERY_RANGE="SYSTEM_DEFAULT",
        )

    def keep(self, role: str, kind: str, own: Path, trusted: Path) -> None:
        """Give a stranger keys: those in `own`, and the issuer of whom it wants to talk with."""
        folder = self.third.state / f"{role}-{kind}"
        folder.mkdir()
        for file in ("own.key", "own.pem"):
            write_private(folder / file, (own / file).read_bytes())
        write_private(folder / "trusted.pem", trusted.read_bytes())


def prepare(lab: Lab, folder: Path) -> None:
    """Pair robot and GPU machine, and make the keys of all strangers."""
    now = datetime.now(UTC)
    robot = lab.robot
    foreign, revoked, expired = (folder / name for name in ("foreign", "revoked", "expired"))
    become_hub(foreign, "robot", now, 365)
    # the GPU machine was paired with a hub that has a new authority since
    pair(robot, lab.gpu)
    robot.link.rename(revoked)
    pair(robot, lab.gpu)
    expired.mkdir()
    key = new_key()
    authority = robot.link / "ca.pem"
    issuer = Issuer(read_key(robot.link / "ca.key"), read_certificate(authority))
    past = now - timedelta(days=40)
    certificate = issue(issuer, "robot", "hub", key.public_key(), past, 30)
    write_private(expired / "own.key", key_to_pem(key))
    write_private(expired / "own.pem", to_pem(certificate))
    become_hub(lab.other.link, "other", now, 365)
    listening = _admit_listeners(lab, folder)
    for kind in LISTENING:
        lab.keep("member", kind, listening.get(kind, foreign), lab.other.link / "ca.pem")
    admit(robot, "third", Peer(lab.third.address, PORT + len(LISTENING)), folder / "member")
    connecting = {"expired": expired, "revoked": revoked, "member": folder / "member"}
    for kind in CONNECTING[:-1]:
        keys = connecting.get(kind, foreign)
        lab.keep("hub", kind, keys, robot.link / "peers" / "gpu.issuer.pem")


def _admit_listeners(lab: Lab, folder: Path) -> dict[str, Path]:
    """Have the other robot connect to each listening stranger; returns keys by kind."""
    kept = {}
    for number, kind in enumerate(LISTENING):
        peer = Peer(lab.third.address, PORT + number)
        for times in range(2):  # the second takes the first one's issuer out
            keys = folder / f"{kind}-{times}"
            admit(lab.other, f"third-{kind}", peer, keys)
            if (kind, times) == ("revoked", 0):
                kept[kind] = keys
        if kind == "expired":
            kept[kind] = folder / "expired-member"
            admit(lab.other, f"third-{kind}", peer, kept[kind], age_days=40, days=30)
    return kept


@dataclass(frozen=True)
class Heard:
    """What everybody has heard at the end."""

    strangers: Mapping[str, Talker]
    robot: Talker
    gpu: Talker
    other: Talker

    @property
    def ours(self) -> tuple[Talker, ...]:
        """Those that no stranger may hear."""
        return (self.robot, self.gpu, self.other)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    folder = tmp_path_factory.mktemp("machines")
    with machines(folder, "robot", "gpu", "other", "third") as made:
        found = Lab(**made)
        prepare(found, folder)
        yield found


@pytest.fixture(scope="module")
def heard(lab: Lab) -> Iterator[Heard]:
    strangers = {f"hub-{kind}": lab.stranger("hub", kind) for kind in CONNECTING}
    for number, kind in enumerate(LISTENING):
        strangers[f"member-{kind}"] = lab.stranger("member", kind, number)
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


@pytest.mark.parametrize(
    "name", [*(f"hub-{kind}" for kind in CONNECTING), *(f"member-{kind}" for kind in LISTENING)]
)
def test_a_stranger_hears_nothing_and_is_not_heard(heard: Heard, name: str) -> None:
    stranger = heard.strangers[name]
    assert stranger.process.poll() is None, stranger.log.read_text()
    assert [stranger.heard(one.name) for one in heard.ours] == [0, 0, 0]
    assert [one.heard(name) for one in heard.ours] == [0, 0, 0]


def test_the_profile_alone_would_let_a_foreign_certificate_in(lab: Lab, heard: Heard) -> None:
    """What these strangers get where `OPENSSL_CONF` is left out: the tests above can fail."""
    heard.gpu.end()
    heard.robot.end()
    careless = lab.gpu.talk(
        "careless",
        link=False,
        FASTRTPS_DEFAULT_PROFILES_FILE=str(lab.gpu.link / "fastdds.xml"),
        ROS_AUTOMATIC_DISCOVERY_RANGE="SYSTEM_DEFAULT",
    )
    # Fast DDS tries again every five seconds, and a busy machine needs several tries
    heard.strangers["hub-foreign"].wait_for("careless", 1, 120.0)
    careless.wait_for("hub-foreign", 1, 120.0)
