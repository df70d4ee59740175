"""Keys of a client, and the URLs that may receive them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import pytest

from rn_backend_openpi.backend import OpenpiBackend
from rn_backend_openpi.options import OpenpiOptions
from rn_backend_openpi.security import check_url, is_loopback
from roboneuron.contract import Observation
from roboneuron.errors import (
    ConfigurationError,
)

Observe = Callable[..., Observation]


def test_the_key_travels_in_the_header_and_comes_from_the_environment(
    policy_server: Any, options: Callable[..., OpenpiOptions], monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = OpenpiBackend(options(api_key_variable="OPENPI_TEST_KEY"))
    monkeypatch.delenv("OPENPI_TEST_KEY", raising=False)
    with pytest.raises(ConfigurationError, match="OPENPI_TEST_KEY"):
        backend.load()
    monkeypatch.setenv("OPENPI_TEST_KEY", "secret")
    backend.load()
    assert policy_server.headers[-1]["Authorization"] == "Api-Key secret"
    backend.close()


def test_an_unencrypted_remote_url_is_warned_about_and_gets_no_key() -> None:
    assert check_url("ws://127.0.0.1:8000", has_key=True, allow_insecure_key=False) == ""
    assert check_url("wss://robots.example", has_key=True, allow_insecure_key=False) == ""
    assert "not encrypted" in check_url(
        "ws://10.0.0.5:8000", has_key=False, allow_insecure_key=False
    )
    assert "not encrypted" in check_url("ws://10.0.0.5:8000", has_key=True, allow_insecure_key=True)
    with pytest.raises(ConfigurationError, match="unencrypted"):
        check_url("ws://10.0.0.5:8000", has_key=True, allow_insecure_key=False)
    for url in ("ws://user:secret@host:1", "ws://host:99999", "ws://:80"):
        with pytest.raises(ConfigurationError) as caught:
            check_url(url, has_key=False, allow_insecure_key=False)
        assert "secret" not in str(caught.value)


def test_the_warning_is_logged_and_shown_in_every_chunk(
    options: Callable[..., OpenpiOptions],
    observe: Observe,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("rn_backend_openpi.security.is_loopback", lambda host: False)
    backend = OpenpiBackend(options())
    with caplog.at_level(logging.WARNING):
        backend.load()
    assert "not encrypted" in caplog.text
    assert "not encrypted" in backend.predict(observe()).note
    backend.close()


def test_loopback_is_recognised_by_the_address_alone() -> None:
    assert all(is_loopback(host) for host in ("localhost", "127.0.0.1", "127.8.8.8", "::1"))
    assert not any(
        is_loopback(host) for host in ("10.0.0.1", "localhost.example", "0.0.0.0", "robot")
    )
