"""Keys, certificates and TLS: which clients the server answers, and its replies to others."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from openpi_clients import (
    KEY,
    KEYS,
    http_get,
    open_client,
    served,
)
from pydantic import ValidationError
from websockets.exceptions import InvalidMessage

from rn_backend_openpi.backend import PolicyBackend
from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.security import Guard
from rn_backend_openpi.server_options import ListenOptions
from roboneuron.errors import ConfigurationError


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    """Files of a key and a certificate."""
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
    return {"certificate": str(pem), "key": str(key), "token_file": str(token)}


def test_health_is_told_to_anybody_and_nothing_else(files: dict[str, str]) -> None:
    with served(keys="token", token_file=files["token_file"]) as url:
        assert http_get(url, "/healthz") == (200, b"OK\n")
        for path in ("/", "/metrics", "/../etc/passwd"):
            status, body = http_get(url, path)
            assert (status, body) == (401, b"")
        status, body = http_get(url, "/", Authorization=f"Api-Key {KEY}")
        assert status == 426  # not a websocket
        assert KEY.encode() not in body


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


def test_key_and_certificate_from_end_to_end(files: dict[str, str]) -> None:
    with served(keys="token", **files) as url:
        given = {"url": url, "profile": "libero", "image_keys": KEYS}
        with pytest.raises(ConfigurationError, match="not trusted"):
            PolicyBackend(PolicyOptions(**given)).load()
        with pytest.raises(ConfigurationError, match="holds no certificate"):
            PolicyBackend(PolicyOptions(**given, ca_file=files["key"])).load()
        given["ca_file"] = files["certificate"]
        with pytest.raises(ConfigurationError, match="refused the key"):
            PolicyBackend(PolicyOptions(**given)).load()
        backend = PolicyBackend(PolicyOptions(**given, token_file=files["token_file"]))
        backend.load()
        backend.close()
        with pytest.raises((InvalidMessage, OSError)):
            open_client(url.replace("wss", "ws"))
