"""Faults of one machine of a link: bad files, or a connection that ends at once. The others stay
connected.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest
from link_members import BOUND_S, admit_at_a_port, answering, relaying
from link_members import robot as robot
from link_pairs import Place

from rn_link.state import PeerConnection, StateFile
from rn_testing.waiting import wait_until

pytestmark = pytest.mark.timeout(120)
States = dict[str, list[PeerConnection]]


@pytest.fixture
def states(monkeypatch: pytest.MonkeyPatch) -> States:
    """Connections of the relay under test in the order of time, by machine."""
    told: States = {}
    store = StateFile.set

    def note(file: StateFile, name: str, connection: PeerConnection) -> None:
        told.setdefault(name, []).append(connection)
        store(file, name, connection)

    monkeypatch.setattr(StateFile, "set", note)
    return told


def wait_for(states: States, name: str, *, is_open: bool) -> PeerConnection:
    """Wait until the machine is connected, or not."""
    wait_until(
        lambda: name in states and states[name][-1].is_open is is_open, BOUND_S, f"{name}: {states}"
    )
    return states[name][-1]


@pytest.mark.parametrize("when", ["before the start", "while connected"])
@pytest.mark.parametrize("content", [None, b"", b"no certificate"])
def test_a_bad_certificate_keeps_only_its_own_machine_out(
    robot: Place, tmp_path: Path, states: States, content: bytes | None, when: str
) -> None:
    with ExitStack() as stack:
        for name in ("gpu", "desk"):
            port = admit_at_a_port(robot, tmp_path / name, name)
            stack.enter_context(answering(tmp_path / name, port))
        certificate = robot.link / "peers" / "desk.pem"
        good = certificate.read_bytes()
        if when == "while connected":
            stack.enter_context(relaying(robot))
            wait_for(states, "desk", is_open=True)
        certificate.unlink()
        if content is not None:
            certificate.write_bytes(content)
        if when == "before the start":
            stack.enter_context(relaying(robot))
        wait_for(states, "gpu", is_open=True)
        told = wait_for(states, "desk", is_open=False)
        assert told.error.startswith("its keys cannot be used: ")
        assert "peers/desk.pem" in told.hint
        certificate.write_bytes(good)
        wait_for(states, "desk", is_open=True)
        assert len(states["gpu"]) == 1, "it stayed connected"


def test_the_hub_connects_again_after_a_drop_right_after_the_handshake(
    robot: Place, tmp_path: Path, states: States
) -> None:
    port = admit_at_a_port(robot, tmp_path / "gpu", "gpu")
    with answering(tmp_path / "gpu", port, drops=3), relaying(robot):
        wait_until(
            lambda: sum(not one.is_open for one in states.get("gpu", [])) >= 3, BOUND_S, "the drops"
        )
        wait_for(states, "gpu", is_open=True)
