"""Keys, certificates and TLS: which clients the server answers, and its replies to others."""

from __future__ import annotations

import shutil
import ssl
import subprocess
from pathlib import Path

import pytest
from openpi_clients import (
    KEY,
    KEYS,
    ask,
    http_get,
    model,
    open_client,
    options_of,
)
from websockets.exceptions import InvalidMessage, InvalidStatus

from rn_backend_openpi.backend import OpenpiBackend
from rn_backend_openpi.case import serving
from rn_backend_openpi.options import OpenpiOptions
from rn_backend_openpi.server import check_listening
from rn_backend_openpi.server_options import ServerOptions
from roboneuron.errors import ConfigurationError


def test_health_is_told_to_anybody_and_nothing_else() -> None:
    with serving(options_of(), model(), key=KEY) as url:
        assert http_get(url, "/healthz") == (200, b"OK\n")
        for path in ("/", "/metrics", "/../etc/passwd"):
            status, body = http_get(url, path)
            assert (status, body) == (401, b"")
        status, body = http_get(url, "/", Authorization=f"Api-Key {KEY}")
        assert status == 426  # not a websocket
        assert KEY.encode() not in body


def test_only_the_key_opens() -> None:
    with serving(options_of(), model(), key=KEY) as url:
        for header in ("", "Api-Key", f"Bearer {KEY}", f"Api-Key {KEY}x", "Api-Key ä"):
            with pytest.raises(InvalidStatus) as caught:
                open_client(
                    url, additional_headers={"Authorization": header.encode().decode("latin-1")}
                )
            assert caught.value.response.status_code == 401
        with open_client(url, additional_headers={"Authorization": f"Api-Key {KEY}"}) as connection:
            assert ask(connection)["actions"].shape == (4, 7)


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
    with serving(options_of(), model(), key=key, tls=tls) as url:
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
            open_client(url.replace("wss", "ws"))


def test_old_tls_is_not_spoken(files: dict[str, str]) -> None:
    _, tls = check_listening("127.0.0.1", ServerOptions.model_validate(files))
    assert tls is not None
    assert tls.minimum_version == ssl.TLSVersion.TLSv1_2
