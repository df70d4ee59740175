"""Connections of a relay: exactly a paired machine hears and is heard, whichever side connects; no
machine disturbs another, and a removed one is cut off.
"""

from __future__ import annotations

import asyncio
import socket
import ssl
import time
from contextlib import AsyncExitStack, suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from link_members import BOUND_S, Net, listening, relaying, state_of, until
from link_members import net as net
from link_pairs import admit, make_hub

from rn_link import peer_link, relay
from rn_link.keys import new_identity, remove_peer
from rn_link.machine import DISCOVERY_PORT, FILE, Machine, read_machine
from rn_link.ports import DISCOVERY, Ports
from rn_link.tls import MOST_HANDSHAKES, tls_context

CUT_OFF_S = 2.0
SAID = b"said by a process here"
FRAME = DISCOVERY.participant + bytes(2) + len(SAID).to_bytes(2) + SAID


@pytest.fixture
def robot(tmp_path: Path, net: Net) -> Path:
    """A hub."""
    make_hub(tmp_path / "robot")
    return tmp_path / "robot"


@pytest.fixture
def gpu(robot: Path, tmp_path: Path) -> Path:
    """A member of it."""
    admit(robot, tmp_path / "gpu", "gpu")
    return tmp_path / "gpu"


def machine_of(folder: Path) -> Machine:
    found = read_machine(folder)
    assert found is not None
    return found


def context_of(member: Path) -> ssl.SSLContext:
    return tls_context(machine_of(member), member, "robot")


def issued_by(identity: str) -> str:
    """A key and a certificate that a paired machine's key has signed."""
    issuer = x509.load_pem_x509_certificate(identity.encode())
    signer = serialization.load_pem_private_key(identity.encode(), None)
    assert isinstance(signer, ec.EllipticCurvePrivateKey)
    fresh = new_identity()
    made = x509.CertificateBuilder(
        issuer_name=issuer.subject,
        subject_name=issuer.subject,
        public_key=x509.load_pem_x509_certificate(fresh.encode()).public_key(),
        serial_number=1,
        not_valid_before=issuer.not_valid_before_utc,
        not_valid_after=issuer.not_valid_after_utc,
    ).sign(signer, hashes.SHA256())
    certificate = made.public_bytes(serialization.Encoding.PEM).decode()
    return certificate + fresh[fresh.index("-----BEGIN PRIVATE") :]


def other_side(net: Net, role: str, context: ssl.SSLContext | None) -> bytes:
    """Accept a hub or connect to a member once, send FRAME, and return what is heard."""
    with suppress(OSError):
        if role == "hub":
            with socket.create_server(("127.0.0.1", net.port)) as listener:
                listener.settimeout(BOUND_S)
                raw, _ = listener.accept()
        else:
            raw = socket.create_connection(("127.0.0.1", net.port), BOUND_S)
        raw.settimeout(BOUND_S)
        with raw if context is None else context.wrap_socket(raw, role == "hub") as connection:
            connection.sendall(FRAME)
            return connection.recv(1000)
    return b""


STRANGERS = ("plain", "nobody", "foreign", "another member", "issued")


@pytest.mark.parametrize("role", ["hub", "member"])
@pytest.mark.parametrize("kind", ["paired", *STRANGERS])
def test_exactly_a_paired_machine_hears_and_is_heard(
    net: Net,
    robot: Path,
    gpu: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    role: str,
) -> None:
    """The other side accepts any certificate, and has the right one in the first case."""
    here, there, name = (robot, gpu, "gpu") if role == "hub" else (gpu, robot, "robot")
    admit(robot, tmp_path / "lab", "lab", "127.0.0.2")
    own = (there / "own.pem").read_text()
    shown = {
        "paired": own,
        "foreign": new_identity(),
        "another member": (tmp_path / "lab" / "own.pem").read_text(),
        "issued": issued_by(own),
    }.get(kind)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if role == "hub" else ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    if shown is not None:
        (tmp_path / "shown.pem").write_text(shown)
        context.load_cert_chain(tmp_path / "shown.pem")
    heard_here: list[bytes] = []
    monkeypatch.setattr(Ports, "deliver", lambda _, name, place, said: heard_here.append(said))

    async def scenario() -> bytes:
        async with relaying(here):
            await until(lambda: role == "hub" or net.is_taken(), "it listens")
            encrypted = None if kind == "plain" else context
            other = asyncio.create_task(asyncio.to_thread(other_side, net, role, encrypted))
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as process:

                def said_and_ended() -> bool:
                    process.sendto(SAID, (net.relay, DISCOVERY_PORT))
                    return other.done() and bool(heard_here or kind != "paired")

                await until(said_and_ended, f"{kind} {state_of(here, name)}")
            return other.result()

    heard_there = asyncio.run(scenario())
    assert (SAID in heard_there, SAID in heard_here) == (kind == "paired", kind == "paired")


def test_a_bad_certificate_keeps_only_its_own_machine_out(
    net: Net, robot: Path, gpu: Path, tmp_path: Path
) -> None:
    admit(robot, tmp_path / "desk", "desk", "127.0.0.2")
    good = (robot / FILE).read_text()
    desk = machine_of(robot).peers["desk"]

    async def scenario() -> None:
        async with (
            listening(net, context_of(gpu)) as of_gpu,
            listening(net, context_of(tmp_path / "desk"), "127.0.0.2"),
            relaying(robot),
        ):
            for bad in ("", "no certificate"):
                await until(lambda: state_of(robot, "desk").is_open, "desk")
                await until(lambda: state_of(robot, "gpu").is_open, "gpu")
                peers = {**machine_of(robot).peers, "desk": desk._replace(certificate=bad)}
                damaged = replace(machine_of(robot), peers=peers)
                (robot / FILE).write_text(damaged.to_json())
                await until(lambda: "keys" in state_of(robot, "desk").error, "desk is told")
                (robot / FILE).write_text(good)
            await until(lambda: state_of(robot, "desk").is_open, "desk again")
            assert of_gpu == [b""], "it stayed connected"

    asyncio.run(scenario())


def test_a_connection_is_told_and_made_again(net: Net, robot: Path, gpu: Path) -> None:
    async def scenario() -> None:
        async with relaying(robot):
            await until(lambda: "Connect call failed" in state_of(robot, "gpu").error, "nobody")
            assert "127.0.0.1 its address" in state_of(robot, "gpu").hint
            async with listening(net, context_of(gpu), drops=3) as heard:
                await until(lambda: len(heard) > 3 and state_of(robot, "gpu").is_open, "drops")
                age = datetime.now(UTC) - datetime.fromisoformat(state_of(robot, "gpu").since)
                assert timedelta(seconds=-1) <= age < timedelta(seconds=BOUND_S)
            await until(lambda: not state_of(robot, "gpu").is_open, "it is lost")

    asyncio.run(scenario())


def test_a_removed_machine_is_cut_off_alone_and_linked_when_paired_again(
    net: Net, robot: Path, gpu: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    admit(robot, tmp_path / "lab", "lab", "127.0.0.2")
    monkeypatch.setattr(relay, "LOOK_S", 0.5)

    async def scenario() -> None:
        async with (
            relaying(robot),
            listening(net, context_of(tmp_path / "lab"), "127.0.0.2") as of_lab,
        ):
            async with listening(net, context_of(gpu)) as of_gpu:
                await until(lambda: state_of(robot, "lab").is_open, "lab")
                await until(lambda: state_of(robot, "gpu").is_open, "gpu")
                begun_s = time.monotonic()
                remove_peer(robot, "gpu")
                await until(lambda: of_gpu == [None], "cut off")
                assert time.monotonic() - begun_s < CUT_OFF_S
            admit(robot, gpu, "gpu")
            async with listening(net, context_of(gpu)) as of_gpu:
                await until(lambda: of_gpu == [b""], "linked again")
            assert of_lab == [b""], "it stayed connected"

    asyncio.run(scenario())


def test_handshakes_with_a_member_are_few_and_short(
    net: Net, robot: Path, gpu: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oldest of too many ends at once, each in time; the hub is not kept out."""

    async def scenario() -> None:
        async with relaying(gpu), AsyncExitStack() as stack:
            await until(net.is_taken, "it listens")
            silent = []
            for _ in range(MOST_HANDSHAKES + 1):
                reader, writer = await asyncio.open_connection("127.0.0.1", net.port)
                stack.callback(writer.close)
                silent.append(asyncio.create_task(reader.read()))
            await asyncio.wait(silent[:1], timeout=1.0)
            assert [one.done() for one in silent].count(True) == 1
            context = tls_context(machine_of(robot), robot, "gpu")
            _, hub = await asyncio.open_connection("127.0.0.1", net.port, ssl=context)
            stack.callback(hub.close)
            await until(lambda: state_of(gpu, "robot").is_open, "the hub is linked")
            await until(lambda: all(one.done() for one in silent), "all are ended")
            assert state_of(gpu, "robot").is_open

    monkeypatch.setattr(peer_link, "ATTEMPT_S", 2.0)
    asyncio.run(scenario())
