"""Keys of a pair and tokens: admission to a policy server, and servers that a robot trusts."""

from __future__ import annotations

import asyncio
import socket
import ssl
import sys
from pathlib import Path
from typing import Any

import pytest
from openpi_clients import (
    INTERFACE,
    KEY,
    http_get,
    loaded,
    make_certificate,
    open_client,
    served,
)
from policy_servers import (
    SEEN,
    Robot,
    Serve,
    answers,
    link_of,
    pair,
    said_to,
)
from pydantic import ValidationError
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import InvalidMessage

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.listener import HANDSHAKE_S, STRANGERS, Listener
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.security import Guard, is_loopback, place_of
from rn_backend_openpi.server_options import ListenOptions
from rn_link.keys import remove_peer
from rn_testing.waiting import wait_until
from roboneuron import (
    ConfigurationError,
    MissingDependencyError,
)

pytestmark = pytest.mark.timeout(200)


def test_a_server_with_a_certificate_of_somebody_else_is_not_trusted(
    serve: Serve, robot: Robot, tmp_path: Path
) -> None:
    server = serve()
    # exchanged: the robot is now paired with another machine of that name
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


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    """Files of a key and a certificate."""
    pem, key = make_certificate(tmp_path)
    token = tmp_path / "a-token"
    token.write_text(KEY)
    token.chmod(0o600)
    return {"certificate": str(pem), "key": str(key), "token_file": str(token)}


def test_a_token_admits_and_whoever_has_none_is_told_nothing(files: dict[str, str]) -> None:
    upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    key = "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    wrong = ("", "x", "Api-Key", "Api-Key x", f"Bearer {KEY}", f"Api-Key {KEY}x")
    with served(keys="token", token_file=files["token_file"]) as url:
        port = int(url.rpartition(":")[2])
        for shown in (*wrong, "Api-Key \xe4", "x" * 3000):
            head = f"GET / HTTP/1.1\r\nHost: x\r\nAuthorization: {shown}\r\n"
            heard = said_to(port, (head + upgrade + key).encode("latin-1"))
            assert heard.startswith(b"HTTP/1.1 401 ")
            assert heard.endswith(b"\r\n\r\n"), "no word about the server"
        assert http_get(url, "/healthz") == (200, b"OK\n")
        for path in ("/", "/metrics", "/status", "/../etc/passwd"):
            assert http_get(url, path) == (401, b"")
        status, body = http_get(url, "/", Authorization=f"Api-Key {KEY}")
        assert status == 426  # not a websocket
        assert KEY.encode() not in body


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620])
@pytest.mark.parametrize("holder", ["key", "certificate"])
def test_a_key_that_others_may_use_is_refused(
    files: dict[str, str], holder: str, mode: int
) -> None:
    """The key is in a file of its own, or beside the certificate."""
    listen = {"keys": "none", "certificate": files["certificate"], "key": files["key"]}
    if holder == "certificate":
        with Path(files["certificate"]).open("a") as file:
            file.write(Path(files["key"]).read_text())
        del listen["key"]
    place = Path(files[holder])
    place.chmod(0o600)
    assert Guard(ListenOptions.model_validate(listen)).context is not None
    place.chmod(mode)
    with pytest.raises(ConfigurationError, match="others can read"):
        Guard(ListenOptions.model_validate(listen))


def test_handshakes_of_tls_are_few(files: dict[str, str]) -> None:
    """The oldest of too many ends at once, and keeps nobody out."""
    listen = {"keys": "none", "certificate": files["certificate"], "key": files["key"]}
    trust = ssl.create_default_context(cafile=files["certificate"])

    async def scenario() -> None:
        entered = asyncio.Event()

        async def handle(_: ServerConnection) -> None:
            entered.set()

        listener = Listener(handle, most=1, pages={})
        listening = socket.create_server(("127.0.0.1", 0))
        port = listening.getsockname()[1]
        context = Guard(ListenOptions.model_validate(listen)).context
        async with await listener.open(listening, context):
            streams = [
                await asyncio.open_connection("127.0.0.1", port) for _ in range(STRANGERS + 2)
            ]
            oldest, _, kept, *_ = (reader for reader, _ in streams)
            assert await asyncio.wait_for(oldest.read(), HANDSHAKE_S / 2) == b""
            assert not kept.at_eof()
            async with connect(f"wss://127.0.0.1:{port}", ssl=trust):
                await asyncio.wait_for(entered.wait(), 10.0)
            for _, writer in streams:
                writer.close()

    asyncio.run(scenario())


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_key_and_certificate_from_end_to_end(
    files: dict[str, str], tmp_path: Path, host: str
) -> None:
    other = tmp_path / "other"
    other.write_text("y" * 32)
    other.chmod(0o600)
    with served(keys="token", host=host, **files) as url:
        port = url.rpartition(":")[2]
        address = f"[::1]:{port}" if host == "::1" else f"127.0.0.1:{port}"
        for place in ({"url": f"wss://{address}", **INTERFACE}, {"address": address}):
            trusted = {**place, "ca_file": files["certificate"]}
            right = {**trusted, "token_file": files["token_file"]}
            for given, word in (
                ({**right, "ca_file": None}, "not trusted"),
                ({**right, "ca_file": files["key"]}, "holds no certificate"),
                ({**trusted, "token_file": str(other)}, "refused the key"),
            ):
                if "address" in place and given["ca_file"] is None:
                    continue  # it is not encrypted then
                with pytest.raises(ConfigurationError, match=word):
                    PolicyBackend(PolicyOptions(**given)).load()
            with loaded(PolicyOptions(**right)) as backend:
                assert backend.predict(SEEN).metrics["connections"] == 1
        with pytest.raises((InvalidMessage, OSError)):
            open_client(url.replace("wss", "ws"))


def test_other_machines_are_let_in_with_key_and_certificate_or_on_purpose(
    files: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    def check(host: str, *names: str, **more: Any) -> tuple[bool, bool]:
        keys = "token" if "token_file" in names else "none"
        chosen = {"host": host, "keys": keys, **{name: files[name] for name in names}, **more}
        guard = Guard(ListenOptions.model_validate(chosen))
        return bool(guard.token), guard.context is not None

    for host in ("127.0.0.1", "localhost", "::1"):
        assert check(host) == (False, False)
    for host, names, lacks in (
        ("0.0.0.0", (), "no token_file and certificate"),
        ("::", (), "no token_file and certificate"),
        ("gpu.lab", ("token_file",), "there is no certificate"),
        ("10.0.0.5", ("certificate", "key"), "there is no token_file"),
    ):
        with pytest.raises(ConfigurationError, match=lacks):
            check(host, *names)
    assert check("10.0.0.5", *files) == (True, True)
    assert caplog.text == ""
    assert check("0.0.0.0", insecure=True) == (False, False)
    assert "without token_file and certificate" in caplog.text
    with pytest.raises(ValidationError, match="no use without certificate"):
        check("127.0.0.1", "key")
    with pytest.raises(ConfigurationError, match="cannot be used"):
        check("127.0.0.1", certificate=files["token_file"])


def test_a_token_is_read_from_a_file_that_only_its_owner_reads(tmp_path: Path) -> None:
    token = tmp_path / "token"
    options = PolicyOptions(address="localhost:1", token_file=token)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        place_of(options)
    token.write_text("a-key-of-some-length\n")
    token.chmod(0o644)
    with pytest.raises(ConfigurationError, match="others can read"):
        place_of(options)
    token.chmod(0o600)
    assert place_of(options).token == "a-key-of-some-length"
    for text in ("short", "with a space in the middle", "ä" * 20):
        token.write_text(text)
        with pytest.raises(ConfigurationError) as caught:
            place_of(options)
        assert text not in str(caught.value)


def test_a_key_comes_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    options = PolicyOptions(
        url="ws://localhost:1", profile="libero", api_key_variable="RN_TEST_KEY"
    )
    monkeypatch.delenv("RN_TEST_KEY", raising=False)
    with pytest.raises(ConfigurationError, match="RN_TEST_KEY"):
        place_of(options)
    monkeypatch.setenv("RN_TEST_KEY", "secret")
    assert place_of(options).token == "secret"


@pytest.mark.parametrize(
    ("place", "encrypted", "result"),
    [
        ({"url": "ws://127.0.0.1:8000"}, False, "sent"),
        ({"url": "wss://robots.example"}, True, "sent"),
        ({"url": "ws://10.0.0.5:8000"}, False, "refused"),
        ({"url": "ws://10.0.0.5:8000", "allow_insecure_key": True}, False, "warned"),
        ({"address": "localhost:1"}, False, "sent"),
        ({"address": "192.0.2.1:7420"}, False, "refused"),
        ({"address": "[::1]:7420"}, False, "sent"),
        ({"address": "[2001:db8::7]:7420"}, False, "refused"),
    ],
)
def test_a_token_is_sent_unencrypted_on_this_machine_or_on_purpose(
    tmp_path: Path, place: dict[str, Any], encrypted: bool, result: str
) -> None:
    token = tmp_path / "token"
    token.write_text("x" * 32)
    token.chmod(0o600)
    options = PolicyOptions(token_file=token, **place)
    if result == "refused":
        with pytest.raises(ConfigurationError, match="not sent unencrypted"):
            place_of(options)
        return
    found = place_of(options)
    assert (found.context is not None, bool(found.warning)) == (encrypted, result == "warned")


@pytest.mark.parametrize("url", ["ws://user:secret@host:1", "ws://host:99999", "ws://:80"])
def test_a_url_that_names_no_host_alone_is_refused(url: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        place_of(PolicyOptions(url=url))
    assert "secret" not in str(caught.value)


def test_loopback_is_recognised_by_the_address_alone() -> None:
    assert all(is_loopback(host) for host in ("localhost", "127.0.0.1", "127.8.8.8", "::1"))
    assert not any(
        is_loopback(host) for host in ("10.0.0.1", "localhost.example", "0.0.0.0", "robot")
    )


def test_machines_that_are_not_paired_are_told_to_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "none"))
    with pytest.raises(ConfigurationError, match="roboneuron link"):
        place_of(PolicyOptions(address="gpu:7420"))
    with pytest.raises(ConfigurationError, match="roboneuron link"):
        Guard(ListenOptions())
    pair(tmp_path / "robot", tmp_path / "gpu", address="192.0.2.7")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "robot"))
    assert place_of(PolicyOptions(address="gpu:7420")).host == "192.0.2.7"
    with pytest.raises(ConfigurationError, match=r"paired with gpu \(192"):
        place_of(PolicyOptions(address="elsewhere:7420"))
    with pytest.raises(ConfigurationError, match="the hub of its link"):
        Guard(ListenOptions())


def test_without_rn_link_a_person_is_told_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rn_link.machine", None)
    with pytest.raises(MissingDependencyError, match="pip install"):
        place_of(PolicyOptions(address="gpu:7420"))
    with pytest.raises(MissingDependencyError, match="pip install"):
        Guard(ListenOptions())
