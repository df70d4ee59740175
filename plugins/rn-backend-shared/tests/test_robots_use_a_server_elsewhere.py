"""Robots and a policy server over TLS and by tokens, with real processes: what they get, and what
happens when one of them goes.
"""

from __future__ import annotations

import importlib
import os
import signal
import socket
import ssl
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from policy_servers import RunningServer, link_of, pair, robot_of

from rn_backend_shared import front as front_module
from rn_backend_shared.backend import SharedBackend
from rn_backend_shared.channel import Channel
from rn_backend_shared.frames import HEADER_BYTES, VERSION, Header, Kind
from rn_backend_shared.front import PolicyServer
from rn_backend_shared.options import ListenOptions, PolicyServerOptions, SharedOptions
from rn_backend_shared.plugin import BACKEND
from rn_backend_shared.processes import ModelProcess
from rn_backend_shared.security import Guard, is_loopback, place_of
from rn_link.certificates import issue, key_to_pem, new_issuer, new_key, to_pem, write_private
from rn_link.machine import read_machine
from rn_link.tls import tls_context
from rn_link_pairing.keeping import remove_peer
from rn_testing.fakes.backend import make_observation
from rn_testing.waiting import wait_until
from roboneuron import (
    Ahead,
    CheckpointError,
    ConfigurationError,
    MissingDependencyError,
    NotReadyError,
    RoboNeuronError,
)
from roboneuron.cli.main import main

pytestmark = pytest.mark.timeout(200)
SEEN = make_observation(BACKEND)
Serve = Callable[..., RunningServer]
Robot = Callable[..., SharedBackend]


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Serve]:
    """Return a function that starts a server; its keys are those of a pair, or a token."""
    with ExitStack() as stack:

        def start(
            models: dict[str, dict[str, Any]] | None = None, *, is_ready: bool = True, **listen: Any
        ) -> RunningServer:
            if listen.get("keys") == "token":
                listen = {"token_file": str(tmp_path / "token"), **listen}
            else:
                pair(tmp_path / "robot", tmp_path / "gpu")
            made = RunningServer(tmp_path, models or {"only": {}}, listen, tmp_path / "gpu")
            stack.callback(made.end)
            return made.start(is_ready=is_ready)

        yield start


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    """Return a function that makes a loaded backend of a robot."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "robot"))
    with ExitStack() as stack:

        def make(address: str, **options: Any) -> SharedBackend:
            made = robot_of(address, **options)
            stack.callback(made.close)
            made.load()
            return made

        yield make


def answers(robot: SharedBackend) -> bool:
    try:
        robot.predict(SEEN)
    except NotReadyError:
        return False
    return True


def said_to(port: int, sent: bytes, context: ssl.SSLContext | None = None) -> bytes:
    """What a stranger hears until the server hangs up."""
    heard = b""
    connected = socket.create_connection(("127.0.0.1", port), 20.0)
    if context is not None:
        connected = context.wrap_socket(connected)
    with connected, suppress(OSError):
        connected.sendall(sent)
        while part := connected.recv(4096):
            heard += part
    return heard


@pytest.mark.parametrize("coding", ["raw", "png"])
def test_answers_over_tls_equal_those_of_the_same_backend_here_bit_for_bit(
    serve: Serve, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, coding: str
) -> None:
    # the model shrinks images itself, so the robot does it before it sends them
    own = {"rows": 6, "shrinks_to": [64, 48]}
    server = serve({"only": {"options": own}})
    far = robot(server.address, coding=coding)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    reflex = importlib.import_module("rn_reflex_plugin")
    monkeypatch.delitem(sys.modules, "rn_reflex_plugin")
    alone = reflex.Reflex(reflex.Options(**own))
    alone.load()
    drawn = np.random.default_rng(0)
    assert SEEN.ee_pose is not None
    for index in range(20):
        image = drawn.integers(0, 256, (224, 224, 3), dtype=np.uint8)
        observation = replace(
            SEEN,
            frames={"primary": replace(SEEN.frames["primary"], image=image)},
            ee_pose=replace(SEEN.ee_pose, position_m=drawn.normal(size=3)),
        )
        there = far.predict(observation)
        assert alone.predict(observation).actions.tobytes() == there.actions.tobytes(), index
    metrics = there.metrics
    assert metrics["shared.image_kb"] < 3 * 64 * 48 / 1e3 + 1.0
    parts = [metrics[f"shared.{part}_ms"] for part in ("link", "queue", "model")]
    assert sum(parts) == pytest.approx(metrics["shared.round_trip_ms"])


def test_jpeg_is_used_as_far_as_it_moves_actions_no_further_than_allowed(
    serve: Serve, robot: Robot
) -> None:
    server = serve()
    metrics = robot(server.address, coding="jpeg", quality=80).predict(SEEN).metrics
    assert 0.0 < metrics["shared.parity_m"] < 0.002
    assert metrics["shared.coding"] == 2.0
    strict = robot(server.address, coding="jpeg", quality=80, parity_m=0.0)
    with pytest.raises(ConfigurationError, match="parity_m = 0 are allowed"):
        strict.predict(SEEN)


def test_real_time_chunking_goes_on_over_the_network(serve: Serve, robot: Robot) -> None:
    far = robot(serve({"only": {"options": {"rows": 6}}}).address, coding="raw")
    first = far.predict(SEEN)
    ahead = Ahead(
        rows=first.actions[1:],
        committed_rows=3,
        step_s=0.1,
        context=first.context,
        context_row=1,
    )
    told = far.predict(replace(SEEN, instruction="x", ahead=ahead))
    assert told.conditioned_rows == 3
    np.testing.assert_array_equal(told.actions[:3], first.actions[1:4])
    assert told.metrics["continues"] == 101.0


def test_strangers_learn_nothing_and_disturb_nobody(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    server = serve()
    one = robot(server.address)
    port = server.port
    hello = Header(Kind.HELLO).pack() + b"[{}, []]"
    for sent in (b"", b"\xff" * 64, b"GET / HTTP/1.1\r\n\r\n", hello):
        heard = said_to(port, sent) if sent else b""
        # at most an alert of TLS, which says that this was no handshake
        assert len(heard) <= 7, heard
    nobody = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    nobody.check_hostname = False
    nobody.verify_mode = ssl.CERT_NONE
    assert said_to(port, hello, nobody) == b""
    # a machine that is paired with somebody else
    pair(tmp_path / "other", tmp_path / "third")
    machine = read_machine(link_of(tmp_path / "other"))
    assert machine is not None
    foreign = tls_context(machine, link_of(tmp_path / "other"), "gpu")
    foreign.verify_mode = ssl.CERT_NONE
    assert said_to(port, hello, foreign) == b""
    assert answers(one)
    assert server.status()["refused_connections"] >= 5


def test_a_server_with_a_certificate_of_somebody_else_is_not_trusted(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    server = serve()
    # swapped: the robot is now paired with another machine of that name
    pair(tmp_path / "robot", tmp_path / "third")
    with pytest.raises(ConfigurationError, match="not trusted"):
        robot(server.address)


def test_a_machine_that_is_removed_is_cut_off_at_both_ends(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    server = serve()
    one = robot(server.address)
    assert answers(one)
    remove_peer(link_of(tmp_path / "robot"), "gpu")
    wait_until(lambda: not answers(one), 20.0, "the robot has left the server")
    pair(tmp_path / "robot", tmp_path / "third")
    assert not answers(one)
    pair(tmp_path / "robot", tmp_path / "gpu")
    wait_until(lambda: answers(one), 30.0, "both have taken the new keys")
    remove_peer(link_of(tmp_path / "gpu"), "robot")
    wait_until(lambda: server.status()["robots"] == 0, 20.0, "the server has hung up")
    assert not answers(one)


def test_a_token_admits_and_a_wrong_one_is_not_answered(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    server = serve(keys="token")
    token = tmp_path / "token"
    assert token.stat().st_mode & 0o777 == 0o600
    assert answers(robot(server.address, token_file=str(token)))
    port = server.port
    for wrong in ('"x"', '""', "null", "7", '"' + "x" * 3000 + '"'):
        text = f'[{{"token": {wrong}}}, []]'.encode()
        assert said_to(port, Header(Kind.HELLO, document_bytes=len(text)).pack() + text) == b""
    newer = bytearray(Header(Kind.HELLO).pack())
    newer[4] = VERSION + 1
    assert said_to(port, bytes(newer)) == b""
    assert said_to(port, Header(Kind.HELLO, array_bytes=5000).pack()) == b""
    assert said_to(port, Header(Kind.STATUS).pack()) == b""


def test_a_peer_of_another_version_is_told_both(serve: Serve, robot: Robot, tmp_path: Path) -> None:
    server = serve()
    folder = link_of(tmp_path / "robot")
    machine = read_machine(folder)
    assert machine is not None
    newer = bytearray(Header(Kind.HELLO).pack())
    newer[4] = VERSION + 1
    heard = said_to(server.port, bytes(newer), tls_context(machine, folder, "gpu"))
    assert f"version {VERSION + 1}".encode() in heard
    assert f"version {VERSION}:".encode() in heard


def test_a_token_is_not_sent_in_clear(tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.write_text("x" * 32)
    options = {"address": "192.0.2.1:7420", "token_file": str(token)}
    token.chmod(0o644)
    with pytest.raises(ConfigurationError, match="Others may read"):
        place_of(SharedOptions.model_validate(options))
    token.chmod(0o600)
    with pytest.raises(ConfigurationError, match="not sent in clear"):
        place_of(SharedOptions.model_validate(options))
    listen = {"host": "0.0.0.0", "keys": "token", "token_file": str(token)}
    with pytest.raises(ConfigurationError, match="in clear"):
        Guard(ListenOptions.model_validate(listen))
    token.write_text("short")
    with pytest.raises(ConfigurationError, match="5 characters"):
        place_of(SharedOptions.model_validate({**options, "address": "localhost:1"}))
    assert [is_loopback(host) for host in ("127.0.0.9", "localhost", "gpu", "10.0.0.1")] == [
        True,
        True,
        False,
        False,
    ]


def test_machines_that_are_not_paired_are_told_to_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "none"))
    with pytest.raises(ConfigurationError, match="roboneuron link"):
        place_of(SharedOptions(address="gpu:7420"))
    with pytest.raises(ConfigurationError, match="roboneuron link"):
        Guard(ListenOptions())
    pair(tmp_path / "robot", tmp_path / "gpu", address="192.0.2.7")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "robot"))
    assert place_of(SharedOptions(address="gpu:7420")).host == "192.0.2.7"
    with pytest.raises(ConfigurationError, match=r"paired with gpu \(192"):
        place_of(SharedOptions(address="elsewhere:7420"))
    with pytest.raises(ConfigurationError, match="the hub of its link"):
        Guard(ListenOptions())


def test_a_model_that_dies_is_an_error_at_once_and_comes_back(serve: Serve, robot: Robot) -> None:
    server = serve({"slow": {"options": {"took_s": 20.0}}, "quick": {}})
    with pytest.raises(ConfigurationError, match="Name one with `model`: slow, quick"):
        robot(server.address)
    with pytest.raises(ConfigurationError, match="no model 'other'"):
        robot(server.address, model="other")
    slow = robot(server.address, model="slow", timeout_s=30.0)
    quick = robot(server.address, model="quick")
    before = server.status()["models"]
    took_s: list[float] = []

    def ask() -> None:
        begun_s = time.monotonic()
        with pytest.raises(NotReadyError, match="'slow' has died"):
            slow.predict(SEEN)
        took_s.append(time.monotonic() - begun_s)

    waiting = threading.Thread(target=ask)
    waiting.start()
    wait_until(lambda: server.status()["models"]["slow"]["busy_s"] > 0.0, 20.0, "it computes")
    os.kill(before["slow"]["pid"], signal.SIGKILL)
    waiting.join(20.0)
    assert took_s[0] < 15.0
    assert answers(quick), "the other model goes on"
    wait_until(
        lambda: server.status()["models"]["slow"]["restarts"] == 1 and server.is_ready(),
        60.0,
        "it is started again",
    )
    after = server.status()["models"]
    assert after["slow"]["lost"] == 1
    assert after["quick"]["restarts"] == 0
    assert after["quick"]["pid"] == before["quick"]["pid"]


def test_a_model_that_hangs_costs_no_more_than_the_deadline(serve: Serve, robot: Robot) -> None:
    server = serve()
    one = robot(server.address, timeout_s=0.3)
    assert answers(one)
    pid = server.status()["models"]["only"]["pid"]
    os.kill(pid, signal.SIGSTOP)
    try:
        begun_s = time.monotonic()
        for _ in range(5):
            with pytest.raises(NotReadyError):
                one.predict(SEEN)
        assert time.monotonic() - begun_s < 5 * 0.3 + 2.0
    finally:
        os.kill(pid, signal.SIGCONT)
    wait_until(lambda: answers(one), 60.0, "it goes on")


@pytest.mark.parametrize("how", ["killed", "frozen"])
def test_a_server_that_goes_is_found_again_and_nobody_waits_beyond_a_deadline(
    serve: Serve, robot: Robot, how: str
) -> None:
    server = serve()
    one = robot(server.address, timeout_s=0.4)
    assert answers(one)
    port, longest_s = server.port, 0.0
    if how == "killed":
        server.kill()
    else:
        os.kill(server.pid, signal.SIGSTOP)
    end_s = time.monotonic() + 3.0
    while time.monotonic() < end_s:
        begun_s = time.monotonic()
        assert not answers(one)
        longest_s = max(longest_s, time.monotonic() - begun_s)
        time.sleep(0.02)
    assert longest_s < 0.4 + 0.3, "a robot has waited beyond its deadline"
    if how == "killed":
        server.start("--port", str(port))
    else:
        os.kill(server.pid, signal.SIGCONT)
    wait_until(lambda: answers(one), 60.0, "the robot is back by itself")


def test_why_a_model_cannot_be_loaded_is_told_to_robots_and_in_the_status(
    serve: Serve, robot: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    server = serve({"bad": {"options": {"fails": True}}, "good": {}}, is_ready=False)
    wait_until(lambda: server.status()["models"]["bad"]["state"] == "failed", 60.0, "it fails")
    with pytest.raises(CheckpointError, match=r"There are no weights\. Copy some"):
        robot(server.address, model="bad")
    wait_until(lambda: server.status()["models"]["good"]["state"] == "ready", 60.0)
    good = robot(server.address, model="good", coding="raw")
    for _ in range(3):
        good.predict(SEEN)
    words = ["serve-policy", "status", "--config", str(server.config)]
    assert main(words) == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[1].split()[:5] == ["model", "state", "pid", "robots", "batches"]
    row = next(line for line in shown if line.startswith("good")).split()
    assert row[1] == "ready"
    assert row[3:5] == ["1", "3"]
    assert "bad: There are no weights." in shown
    assert main([*words, "--json"]) == 0
    assert '"answered": 3' in capsys.readouterr().out
    assert server.end() == 0
    assert main(words) != 0
    assert "No policy server" in capsys.readouterr().err


def test_a_server_that_ends_ends_its_models_even_when_it_is_killed(serve: Serve) -> None:
    server = serve({"a": {}, "b": {}})
    pids = [model["pid"] for model in server.status()["models"].values()]
    server.kill()
    wait_until(lambda: not any(Path(f"/proc/{pid}/exe").exists() for pid in pids), 60.0)


def admitted(port: int, token: Path) -> tuple[socket.socket, Channel]:
    """A robot that does as it likes."""
    raw = socket.create_connection(("127.0.0.1", port), 20.0)
    channel = Channel(raw)
    channel.send(Header(Kind.HELLO), {"token": token.read_text().strip()}, 10.0)
    assert channel.receive(time.monotonic() + 10.0).document()["state"] == "ready"
    return raw, channel


def test_robots_that_send_nonsense_are_left_without_harm(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    server = serve(keys="token")
    token = tmp_path / "token"
    one = robot(server.address, token_file=str(token))
    port = server.port
    for nonsense in (
        b"\xff" * HEADER_BYTES,
        Header(Kind.REQUEST, 0).pack(),
        Header(Kind.ANSWER, 1).pack(),
        Header(Kind.STATUS).pack(),
        Header(Kind.REQUEST, 1, array_bytes=(1 << 25) + 1).pack(),
        Header(Kind.REQUEST, 1, document_bytes=1 << 18).pack() + b"[",
    ):
        raw, channel = admitted(port, token)
        raw.sendall(nonsense)
        raw.shutdown(socket.SHUT_WR)
        with suppress(OSError):
            while raw.recv(4096):
                pass
        channel.close()
    raw, channel = admitted(port, token)
    for number in (5, 5):  # the second one is repeated
        channel.send(Header(Kind.REQUEST, number, 0, 5.0), {"observation": {}}, 5.0)
    told = channel.receive(time.monotonic() + 10.0)
    assert told.header.number == 5
    assert told.document()["error"] == "invalid_input"
    with pytest.raises(OSError, match="closed"):
        channel.receive(time.monotonic() + 10.0)
    channel.close()
    assert answers(one)


def test_no_more_robots_than_allowed_are_taken(serve: Serve, robot: Robot, tmp_path: Path) -> None:
    server = serve(keys="token", robots=1)
    token = str(tmp_path / "token")
    one = robot(server.address, token_file=token)
    with pytest.raises(ConfigurationError, match="no more are taken"):
        robot(server.address, token_file=token)
    assert answers(one)
    one.close()
    wait_until(lambda: server.status()["robots"] == 0, 20.0)
    assert answers(robot(server.address, token_file=token))


@pytest.mark.slow
@pytest.mark.parametrize("keys", ["link", "token"])
def test_ten_thousand_connections_keep_no_robot_out(
    serve: Serve, robot: Robot, tmp_path: Path, keys: str
) -> None:
    server = serve(keys=keys)
    options = {"token_file": str(tmp_path / "token")} if keys == "token" else {}
    one = robot(server.address, **options)
    port, answered = server.port, 0
    with ExitStack() as stack:
        crowd: list[socket.socket] = []
        for index in range(10_000):
            silent = socket.socket()
            silent.settimeout(10.0)
            with suppress(OSError):
                silent.connect(("127.0.0.1", port))
                silent.send(b"\x16\x03\x01" if index % 2 else b"RNPI")
            crowd.append(stack.enter_context(silent))
            if len(crowd) > 500:
                crowd.pop(0).close()
            if index % 500 == 0:
                answered += answers(one)
        assert answered == 20, "who is connected is served"
        assert answers(robot(server.address, **options)), "a new robot comes in"
    status = server.status()
    assert status["refused_connections"] >= 9000
    threads = len(list(Path(f"/proc/{server.pid}/task").iterdir()))
    assert threads < 600


def test_a_wrong_file_is_one_clear_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "policies.toml"
    for text, expected in (
        ("", "models"),
        ("[models.a]\n", "backend"),
        ("[models.a]\nbackend = 'oft'\nmodle = 1", "modle"),
        ("[listen]\nkeys = 'token'\n[models.a]\nbackend = 'oft'", "token_file"),
        ("[[[", "cannot be read"),
    ):
        path.write_text(text)
        assert main(["serve-policy", "--config", str(path)]) != 0
        assert expected in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, "name the backend"),
        ({"backend": "oft", "model": "a"}, "belong to a server with an address"),
        ({"address": "gpu:1", "ca": "x"}, "ca belongs"),
    ],
)
def test_options_that_do_not_fit_are_refused(options: dict[str, str], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        SharedOptions.model_validate(options)


def test_a_server_that_is_not_there_is_an_error_after_a_while(
    robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    token = tmp_path / "token"
    token.write_text("x" * 32)
    token.chmod(0o600)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(RoboNeuronError, match="cannot be reached"):
        robot(f"127.0.0.1:{port}", token_file=str(token), start_timeout_s=0.5)


def test_a_token_goes_over_tls_where_the_servers_certificate_is_known(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    issuer = new_issuer("server", datetime.now(UTC))
    key = new_key()
    shown = issue(issuer, "server", "member", key.public_key(), datetime.now(UTC), 30)
    write_private(tmp_path / "server.pem", to_pem(shown))
    write_private(tmp_path / "server.key", key_to_pem(key))
    write_private(tmp_path / "ca.pem", to_pem(issuer.certificate))
    write_private(
        tmp_path / "other.pem", to_pem(new_issuer("other", datetime.now(UTC)).certificate)
    )
    server = serve(
        keys="token",
        host="0.0.0.0",
        certificate=str(tmp_path / "server.pem"),
        key=str(tmp_path / "server.key"),
    )
    options = {"token_file": str(tmp_path / "token"), "coding": "raw"}
    assert answers(robot(server.address, ca=str(tmp_path / "ca.pem"), **options))
    with pytest.raises(ConfigurationError, match="not trusted"):
        robot(server.address, ca=str(tmp_path / "other.pem"), **options)
    with pytest.raises(NotReadyError, match="closed the connection without a word"):
        robot(server.address, start_timeout_s=0.5, **options)


def test_without_rn_link_a_person_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rn_link.machine", None)
    with pytest.raises(MissingDependencyError, match="pip install"):
        place_of(SharedOptions(address="gpu:7420"))
    with pytest.raises(MissingDependencyError, match="pip install"):
        Guard(ListenOptions())


@pytest.fixture
def front(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PolicyServer]:
    """A server in this process that is impatient, without a model."""
    monkeypatch.setattr(front_module, "_FRAME_S", 0.3)
    monkeypatch.setattr(front_module, "_ADMIT_S", 0.5)
    monkeypatch.setattr(ModelProcess, "start", lambda process: None)
    (tmp_path / "run").mkdir(mode=0o700)
    listen = {"port": 0, "keys": "token", "token_file": str(tmp_path / "token")}
    options = PolicyServerOptions.model_validate(
        {"listen": listen, "models": {"only": {"backend": "reflex"}}}
    )
    server = PolicyServer(options, tmp_path / "run", "front")
    thread = threading.Thread(target=server.run)
    thread.start()
    assert server.has_begun.wait(30.0)
    yield server
    server.stop()
    thread.join(60.0)


def test_who_stalls_is_left_before_and_after_it_was_admitted(
    front: PolicyServer, tmp_path: Path
) -> None:
    with socket.create_connection(("127.0.0.1", front.port), 20.0) as silent:
        assert silent.recv(1) == b""
    with socket.create_connection(("127.0.0.1", front.port), 20.0) as slow, suppress(OSError):
        for byte in Header(Kind.HELLO).pack() * 10:  # a byte now and then is no introduction
            slow.send(bytes([byte]))
            time.sleep(0.05)
    wait_until(lambda: front.status()["refused_connections"] == 2, 20.0, "both are left")
    raw = socket.create_connection(("127.0.0.1", front.port), 20.0)
    channel = Channel(raw)
    token = (tmp_path / "token").read_text().strip()
    channel.send(Header(Kind.HELLO), {"token": token}, 10.0)
    assert channel.receive(time.monotonic() + 10.0).document()["state"] == "loading"
    wait_until(lambda: front.status()["robots"] == 1, 20.0)
    raw.sendall(Header(Kind.REQUEST, 1, 0, 5.0, 1000).pack())
    with pytest.raises(OSError, match="closed"):
        channel.receive(time.monotonic() + 20.0)
    channel.close()
    wait_until(lambda: front.status()["robots"] == 0, 20.0)


def test_a_robot_is_told_when_there_is_no_model(front: PolicyServer, tmp_path: Path) -> None:
    channel = Channel(socket.create_connection(("127.0.0.1", front.port), 20.0))
    token = (tmp_path / "token").read_text().strip()
    channel.send(Header(Kind.HELLO), {"token": token}, 10.0)
    channel.receive(time.monotonic() + 10.0)
    channel.send(Header(Kind.REQUEST, 1, 77, 5.0), {"observation": {}}, 5.0)
    told = channel.receive(time.monotonic() + 10.0)
    assert (told.header.number, told.header.clock_ns) == (1, 77)
    assert told.document()["error"] == "not_ready"
    channel.close()
    assert front.status()["models"]["only"]["lost"] == 1
