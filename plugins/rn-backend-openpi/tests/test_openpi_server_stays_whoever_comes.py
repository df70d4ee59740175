"""The server with clients that are strangers, slow, silent, many, or send anything: one connection
ends, the others are answered as before.
"""

from __future__ import annotations

import http.client
import re
import shutil
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus
from websockets.sync.client import ClientConnection, connect

sys.path.insert(0, str(Path(__file__).parent))
from openpi_format import decode, encode

sys.path.pop(0)

from rn_backend_openpi.backend import OpenpiBackend
from rn_backend_openpi.case import Reflex, serving
from rn_backend_openpi.options import OpenpiOptions
from rn_backend_openpi.server import check_listening
from rn_backend_openpi.server_options import ServerOptions
from rn_backend_openpi.serving import make_policy
from rn_testing.fakes.site import PluginSite
from roboneuron import ActionChunk
from roboneuron.config import parse_config
from roboneuron.errors import ConfigurationError
from roboneuron.plugins.discovery import discover

KEY = "a-key-of-some-length"
SLACK_S = 10.0
"""What scheduling on a busy machine may add to a bounded wait."""
STATE = np.array([0.4, 0.0, 0.5, np.pi, 0.0, 0.0, 0.04, -0.04])
GREY = np.full((32, 48, 3), 90, dtype=np.uint8)
REQUEST = {"observation/image": GREY, "observation/state": STATE, "prompt": "go"}
KEYS = {"primary": "observation/image"}


def _options(**server: Any) -> OpenpiOptions:
    return OpenpiOptions(profile="libero", image_keys=KEYS, server=server)


def _model() -> Reflex:
    return Reflex(step_s=0.05)


def _open(url: str, **options: Any) -> ClientConnection:
    connection = connect(url, compression=None, max_size=None, proxy=None, **options)
    connection.metadata = msgpack.unpackb(connection.recv(timeout=SLACK_S))
    return connection


def _ask(connection: ClientConnection, request: Any = REQUEST) -> Any:
    data = request if isinstance(request, bytes | str) else msgpack.packb(request, default=encode)
    connection.send(data)
    told = connection.recv(timeout=SLACK_S)
    return told if isinstance(told, str) else msgpack.unpackb(told, object_hook=decode)


@contextmanager
def _served(**server: Any) -> Iterator[str]:
    with serving(_options(**server), _model()) as url:
        yield url


def _get(url: str, path: str, **headers: str) -> tuple[int, bytes]:
    host, _, port = url.partition("://")[2].partition(":")
    asked = http.client.HTTPConnection(host, int(port), timeout=SLACK_S)
    asked.request("GET", path, headers=headers)
    answer = asked.getresponse()
    return answer.status, answer.read()


def test_a_plain_client_gets_metadata_and_an_answer_with_times() -> None:
    with _served() as url, _open(url) as connection:
        told = connection.metadata
        assert (told["profile"], told["action_space"], told["action_dim"]) == (
            "libero",
            "ee_delta",
            7,
        )
        assert told["image_keys"] == KEYS
        assert (told["image_resolution"], told["step_s"]) == ([224, 224], 0.05)
        assert [channel["unit"] for channel in told["action_channels"]] == [
            *("m",) * 3,
            *("rad",) * 3,
            "opening",
        ]
        first, second = _ask(connection), _ask(connection)
        assert first["actions"].shape == (4, 7)
        assert first["actions"].dtype == np.float64
        assert first["step_s"] == 0.05
        assert first["policy_timing"]["infer_ms"] >= 0.0
        assert first["server_timing"].keys() == {"infer_ms"}
        assert second["server_timing"].keys() == {"infer_ms", "prev_total_ms"}
        assert _ask(connection, {"endpoint": "reset"}) == {"status": "reset successful"}
        arena = {**REQUEST, "endpoint": "infer", "session_id": "abc"}
        np.testing.assert_array_equal(_ask(connection, arena)["actions"], first["actions"])


def test_health_is_told_to_anybody_and_nothing_else() -> None:
    with serving(_options(), _model(), key=KEY) as url:
        assert _get(url, "/healthz") == (200, b"OK\n")
        for path in ("/", "/metrics", "/../etc/passwd"):
            status, body = _get(url, path)
            assert (status, body) == (401, b"")
        status, body = _get(url, "/", Authorization=f"Api-Key {KEY}")
        assert status == 426  # no websocket
        assert KEY.encode() not in body


def test_only_the_key_opens() -> None:
    with serving(_options(), _model(), key=KEY) as url:
        for header in ("", "Api-Key", f"Bearer {KEY}", f"Api-Key {KEY}x", "Api-Key ä"):
            with pytest.raises(InvalidStatus) as caught:
                _open(url, additional_headers={"Authorization": header.encode().decode("latin-1")})
            assert caught.value.response.status_code == 401
        with _open(url, additional_headers={"Authorization": f"Api-Key {KEY}"}) as connection:
            assert _ask(connection)["actions"].shape == (4, 7)


def test_more_clients_than_may_are_refused_and_a_place_that_is_left_is_free_again() -> None:
    with _served(clients=2) as url, ExitStack() as opened:
        first = opened.enter_context(_open(url))
        opened.enter_context(_open(url))
        with pytest.raises(InvalidStatus) as caught:
            _open(url)
        assert caught.value.response.status_code == 503
        first.close()
        deadline_s = time.monotonic() + SLACK_S
        while True:
            try:
                opened.enter_context(_open(url))
                break
            except InvalidStatus:
                assert time.monotonic() < deadline_s


NAN = STATE.copy()
NAN[2] = np.nan
DEEP: Any = 1
for _ in range(40):
    DEEP = [DEEP]


@pytest.mark.parametrize(
    ("request_", "word"),
    [
        (b"", "InvalidInputError"),
        (b"\xc1", "not of openpi's format"),
        (b"\x00" * 1000, "InvalidInputError"),
        ("text", "this one is text"),
        (msgpack.packb([1]), "expected a map"),
        (msgpack.packb(np.zeros(3), default=encode), "this one is an array"),
        ({**REQUEST, "prompt": DEEP}, "deep in each other"),
        ({**REQUEST, "x": list(range(5000))}, "exceeds"),
        ({**REQUEST, "prompt": "x" * 100_000}, "exceeds"),
        ({**REQUEST, "endpoint": "shell"}, "no endpoint 'shell'"),
        ({**REQUEST, "observation/state": NAN}, "UnsafeError"),
        ({**REQUEST, "observation/state": np.zeros(3)}, "expected \\(8,\\)"),
        ({**REQUEST, "observation/image": GREY[..., 0]}, "no uint8 array"),
        ({**REQUEST, "roboneuron/time_left_s": -1.0}, "expected seconds"),
        ({**REQUEST, "roboneuron/time_left_s": float("nan")}, "expected seconds"),
        ({**REQUEST, "roboneuron/time_left_s": 0.0}, "NotReadyError"),
        (
            {
                **REQUEST,
                "observation/image": {
                    b"__ndarray__": True,
                    b"data": b"",
                    b"dtype": "|u1",
                    b"shape": [2**40, 0],
                },
            },
            "InvalidInputError",
        ),
        (
            {
                **REQUEST,
                "x": {b"__ndarray__": True, b"data": b"1" * 8, b"dtype": "|O", b"shape": [1]},
            },
            "not a number type",
        ),
        ({"prompt": "go"}, "is missing"),
        ({1: 2}, "InvalidInputError"),
    ],
)
def test_garbage_ends_its_own_connection_and_no_other(request_: Any, word: str) -> None:
    with _served() as url, _open(url) as good:
        before = _ask(good)["actions"]
        with _open(url) as bad:
            told = _ask(bad, request_)
            assert isinstance(told, str)
            assert re.search(word, told), told
            assert "Traceback" not in told
            assert "\n" not in told
            with pytest.raises(ConnectionClosed) as caught:
                bad.recv(timeout=SLACK_S)
            assert caught.value.rcvd is not None
            assert caught.value.rcvd.code == 1011
        np.testing.assert_array_equal(_ask(good)["actions"], before)


def test_a_frame_that_is_too_large_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rn_backend_openpi.server.MOST_BYTES", 2**20)
    with _served() as url, _open(url) as good:
        with _open(url) as bad:
            with suppress(ConnectionClosed):
                bad.send(b"x" * 2**21)
            with pytest.raises(ConnectionClosed) as caught:
                bad.recv(timeout=SLACK_S)
        assert caught.value.rcvd is not None
        assert caught.value.rcvd.code == 1009
        assert _ask(good)["actions"].shape == (4, 7)


def test_random_bytes_before_the_handshake_disturb_nobody() -> None:
    rng = np.random.default_rng(7)
    with _served() as url, _open(url) as good:
        address = ("127.0.0.1", int(url.rsplit(":", 1)[1]))
        for size in (1, 10, 1000, 100_000):
            with socket.create_connection(address, timeout=SLACK_S) as stranger, suppress(OSError):
                stranger.sendall(rng.bytes(size))
        assert _ask(good)["actions"].shape == (4, 7)


def _is_closed(plain: socket.socket) -> bool:
    """Whether the other end has closed; told at once."""
    plain.settimeout(0.5)
    try:
        return plain.recv(1) == b""
    except ConnectionResetError:
        return True
    except TimeoutError:
        return False


def test_many_who_say_nothing_keep_nobody_out() -> None:
    with _served(clients=4) as url, ExitStack() as opened:
        good = opened.enter_context(_open(url))
        address = ("127.0.0.1", int(url.rsplit(":", 1)[1]))
        strangers = [
            opened.enter_context(socket.create_connection(address, timeout=SLACK_S))
            for _ in range(300)
        ]
        start = time.monotonic()
        late = opened.enter_context(_open(url))
        assert _ask(late)["actions"].shape == (4, 7)
        assert _ask(good)["actions"].shape == (4, 7)
        # far less than a handshake may last: nobody had to time out first
        assert time.monotonic() - start < 4.0
        # no more are kept than the bound says, the newest ones
        assert [_is_closed(stranger) for stranger in strangers[:200]] == [True] * 200


class Wide(Reflex):
    """Answers with so many numbers that no socket buffer holds them."""

    def answer(self, observations: Any) -> Any:
        chunks = super().answer(observations)
        rows = np.tile(chunks[0].actions, (20_000, 1))
        return [ActionChunk(actions=rows, step_s=0.1) for _ in observations]


PLAIN = msgpack.packb(
    {"observation/image": GREY, "prompt": "go", "observation/gripper_open": STATE[:1]},
    default=encode,
)


@contextmanager
def _reading_nothing(url: str) -> Iterator[None]:
    """A client that asks again and again and reads no answer."""
    with socket.socket() as plain:
        plain.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        plain.connect(("127.0.0.1", int(url.rsplit(":", 1)[1])))
        quiet = {"compression": None, "max_size": None, "proxy": None, "close_timeout": 0.1}
        slow = connect(url, sock=plain, max_queue=1, **quiet)
        with suppress(ConnectionClosed, OSError):
            for _ in range(4):
                slow.send(PLAIN)
        yield
        plain.close()
        slow.close()


def test_a_client_that_does_not_read_holds_nobody_up() -> None:
    # were it waited for, that would be for a minute
    options = OpenpiOptions(profile="roboneuron", server={"send_timeout_s": 60.0})
    with serving(options, Wide()) as url, _reading_nothing(url), _open(url) as good:
        start = time.monotonic()
        for _ in range(3):
            assert _ask(good, PLAIN)["actions"].shape == (80_000, 7)
        assert time.monotonic() - start < 30.0


def test_a_client_that_does_not_read_is_dropped(caplog: pytest.LogCaptureFixture) -> None:
    options = OpenpiOptions(profile="roboneuron", server={"send_timeout_s": 0.3, "clients": 1})
    with serving(options, Wide()) as url, _reading_nothing(url):
        deadline_s = time.monotonic() + 30.0
        while True:
            try:
                with _open(url) as good:  # the only place is free again
                    assert _ask(good, PLAIN)["actions"].shape == (80_000, 7)
                break
            except InvalidStatus:
                assert time.monotonic() < deadline_s
    assert "does not read; it is dropped" in caplog.text


def test_a_client_that_asks_nothing_for_long_is_let_go() -> None:
    with _served(idle_timeout_s=0.3) as url, _open(url) as idle:
        with pytest.raises(ConnectionClosed) as caught:
            idle.recv(timeout=SLACK_S)
        assert caught.value.rcvd is not None
        assert (caught.value.rcvd.code, caught.value.rcvd.reason) == (1001, "idle")


class Stuck(Reflex):
    """Does not answer until it is released."""

    released = threading.Event()

    def answer(self, observations: Any) -> Any:
        self.released.wait(60.0)
        return super().answer(observations)


def test_a_model_that_hangs_is_told_in_time() -> None:
    with serving(_options(answer_timeout_s=0.3), Stuck(step_s=0.05)) as url:
        with _open(url) as connection:
            start = time.monotonic()
            assert "gave no answer before the deadline" in _ask(connection)
            assert time.monotonic() - start < 0.3 + SLACK_S
        Stuck.released.set()


def test_a_server_that_ends_waits_for_no_model() -> None:
    Stuck.released.clear()
    with ExitStack() as kept:
        with serving(_options(answer_timeout_s=1.0), Stuck(step_s=0.05)) as url:
            connection = kept.enter_context(_open(url))
            connection.send(msgpack.packb(REQUEST, default=encode))
            threading.Timer(3.0, Stuck.released.set).start()
            start = time.monotonic()
        # the model answers after the loop has ended, and closing waits for it, not for the client
        assert time.monotonic() - start < 3.0 + SLACK_S


class Broken(Reflex):
    """Fails as no backend should."""

    def answer(self, observations: Any) -> Any:
        raise KeyError("/secret/path")


def test_a_fault_of_the_backend_is_logged_and_not_told(caplog: pytest.LogCaptureFixture) -> None:
    with serving(_options(), Broken(step_s=0.05)) as url, _open(url) as connection:
        assert _ask(connection) == "PluginError: see the server's log."
    assert "/secret/path" in caplog.text


def test_a_chunk_of_another_period_than_the_profiles_is_refused(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with serving(_options(), Reflex(step_s=0.1)) as url, _open(url) as connection:
        assert _ask(connection) == "PluginError: see the server's log."
    assert "rows every 0.1 s, the profile 'libero' has one every 0.05 s" in caplog.text


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    """A key and a certificate."""
    if shutil.which("openssl") is None:
        pytest.skip("makes a certificate with openssl")
    pem, key, token = tmp_path / "c.pem", tmp_path / "k.pem", tmp_path / "token"
    command = (
        "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 "
        f"-subj /CN=localhost -addext subjectAltName=IP:127.0.0.1 -keyout {key} -out {pem}"
    )
    subprocess.run(command.split(), check=True, capture_output=True, timeout=30)
    token.write_text(KEY)
    token.chmod(0o600)
    return {"certificate": str(pem), "certificate_key": str(key), "token_file": str(token)}


def test_other_machines_are_let_in_with_key_and_certificate_or_on_purpose(
    files: dict[str, str], caplog: pytest.LogCaptureFixture
) -> None:
    def check(host: str, *names: str, insecure: bool = False) -> tuple[bool, bool]:
        chosen = {name: files[name] for name in names}
        options = ServerOptions.model_validate({**chosen, "insecure": insecure})
        key, tls = check_listening(host, options)
        return key is not None, tls is not None

    for host in ("127.0.0.1", "localhost", "::1"):
        assert check(host) == (False, False)
    with pytest.raises(ConfigurationError, match="no token_file and certificate"):
        check("0.0.0.0")
    with pytest.raises(ConfigurationError, match="there is no certificate"):
        check("gpu.lab", "token_file")
    with pytest.raises(ConfigurationError, match="there is no token_file"):
        check("10.0.0.5", "certificate", "certificate_key")
    assert check("10.0.0.5", *files) == (True, True)
    assert caplog.text == ""
    assert check("0.0.0.0", insecure=True) == (False, False)
    assert "without token_file and certificate" in caplog.text
    with pytest.raises(ConfigurationError, match="no use without certificate"):
        check("127.0.0.1", "certificate_key")
    broken = ServerOptions.model_validate({"certificate": files["token_file"]})
    with pytest.raises(ConfigurationError, match="cannot be used"):
        check_listening("127.0.0.1", broken)


def test_key_and_certificate_from_end_to_end(files: dict[str, str], tmp_path: Path) -> None:
    key, tls = check_listening("127.0.0.1", ServerOptions.model_validate(files))
    with serving(_options(), _model(), key=key, tls=tls) as url:
        given = {"url": url, "profile": "libero", "image_keys": KEYS}
        with pytest.raises(ConfigurationError, match="not trusted"):
            OpenpiBackend(OpenpiOptions(**given)).load()
        given["ca_file"] = files["certificate"]
        with pytest.raises(ConfigurationError, match="refused the key"):
            OpenpiBackend(OpenpiOptions(**given)).load()
        backend = OpenpiBackend(OpenpiOptions(**given, api_key_file=files["token_file"]))
        backend.load()
        backend.close()
        with pytest.raises((InvalidMessage, OSError)):
            _open(url.replace("wss", "ws"))


def test_old_tls_is_not_spoken(files: dict[str, str]) -> None:
    _, tls = check_listening("127.0.0.1", ServerOptions.model_validate(files))
    assert tls is not None
    assert tls.minimum_version == ssl.TLSVersion.TLSv1_2


SOURCE = """
import numpy as np
from roboneuron import ActionChunk, BackendSpec, hookimpl

class Still:
    def __init__(self, config, *, runtime=None, acceleration=None):
        pass
    def load(self):
        print("loaded", flush=True)
    def predict(self, observation):
        rows = np.zeros((2, 7))
        rows[:, 6] = observation.gripper_open
        return ActionChunk(actions=rows, step_s=0.05)
    def reset(self):
        pass
    def close(self):
        print("closed", flush=True)

class Batched(Still):
    def predict_batch(self, observations):
        return [self.predict(observation) for observation in observations]

@hookimpl
def roboneuron_backends():
    common = {"summary": "Does not move.", "needs_state": True}
    return [
        BackendSpec(name="still", target=__name__ + ":Still", **common),
        BackendSpec(name="still-many", target=__name__ + ":Batched", **common),
    ]
"""
CONFIG = """
[robot]
name = "fr3"
{inference}
[plugins.openpi]
{openpi}
[plugins.openpi.server]
{server}
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of plugins with two small backends."""
    folder = tmp_path / "site"
    PluginSite(path=folder).install("rn-still", SOURCE, header="")
    monkeypatch.syspath_prepend(str(folder))
    return folder


def _text(backend: str, openpi: str = "", server: str = "") -> str:
    inference = f'[inference]\nbackend = "{backend}"' if backend else ""
    return CONFIG.format(inference=inference, openpi=openpi, server=server)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        (_text(""), "has no \\[inference\\]"),
        (_text("openpi"), "asks a server itself"),
        (_text("mars"), "There is no backend 'mars'"),
        (
            _text("still-many", 'profile = "ur5e"\njoints = ["a", "b", "c", "d", "e", "f"]'),
            "answers in 'ee_delta_base', profile 'ur5e' is for 'joint_position@20:a,b",
        ),
        (
            _text("still-many", 'profile = "libero"\nimage_keys = {wrist = "w"}'),
            "needs the camera 'primary'; profile 'libero' has keys for wrist",
        ),
        (
            _text("still-many", 'profile = "roboneuron"\nspace = "ee_pose"\nrate_hz = 5.0'),
            "answers in 'ee_delta_base', profile 'roboneuron' is for 'ee_pose@5:x,y,z",
        ),
        (_text("still"), "set stateless = true in \\[plugins.openpi.server\\]"),
    ],
)
def test_what_cannot_be_served_is_refused_by_name(site: Path, text: str, word: str) -> None:
    registry = discover()
    config = parse_config(text, registry=registry)
    options = OpenpiOptions.model_validate(dict(config.options("openpi")))
    with pytest.raises(ConfigurationError, match=word):
        make_policy(config, registry, options).load()


def test_the_command_serves_until_it_is_told_to_end(site: Path, tmp_path: Path) -> None:
    config = tmp_path / "gpu.toml"
    config.write_text(_text("still", server="stateless = true\nport = 0"))
    process = subprocess.Popen(
        [sys.executable, "-m", "roboneuron.cli.main", "openpi-server", "--config", str(config)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={"PYTHONPATH": str(site), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
    )
    assert process.stdout is not None
    try:
        lines = [process.stdout.readline().strip() for _ in range(2)]
        assert lines[0] == "loaded"
        assert lines[1].endswith("(backend still, profile roboneuron, ee_delta)")
        url = lines[1].split()[2]
        assert _get(url, "/healthz") == (200, b"OK\n")
        backend = OpenpiBackend(OpenpiOptions(url=url, profile="roboneuron"))
        backend.load()
        backend.close()
        process.terminate()
        out, err = process.communicate(timeout=30.0)
        assert (process.returncode, out.strip()) == (0, "closed"), err
    finally:
        process.kill()


def test_a_port_that_is_taken_is_said(site: Path, tmp_path: Path) -> None:
    config = tmp_path / "gpu.toml"
    config.write_text(_text("still-many"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = subprocess.run(
            [
                *(sys.executable, "-m", "roboneuron.cli.main", "openpi-server"),
                *("--config", str(config), "--port", str(port)),
            ],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            env={"PYTHONPATH": str(site), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
        )
    assert done.returncode == 2
    assert f"cannot listen on 127.0.0.1:{port}" in done.stderr
