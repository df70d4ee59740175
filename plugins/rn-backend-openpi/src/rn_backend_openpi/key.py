"""API keys from files, and the connections that may carry them."""

from __future__ import annotations

import ipaddress
import os
import stat
from pathlib import Path
from urllib.parse import urlsplit

from roboneuron import ConfigurationError

_LEAST, _MOST = 16, 4096
_NEW = "Make one with: umask 077; python -c 'import secrets; print(secrets.token_urlsafe(32))' >"


def read_key(path: Path) -> str:
    """The key in a file, without the final line break.

    Raises:
        ConfigurationError: the file cannot be read, is readable by others, or holds no key of at
            least 16 printable ASCII characters.
    """
    try:
        found = path.stat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > _MOST:
            raise ConfigurationError(f"{path} is no small file with a key.")
        text = path.read_text(encoding="ascii").strip()
    except (OSError, UnicodeError) as error:
        raise ConfigurationError(f"The key {path} cannot be read: {error}.") from error
    if found.st_mode & 0o077:
        raise ConfigurationError(
            f"The key {path} can be read by others.", hint=f"Run: chmod 600 {path}"
        )
    return check_key(text, str(path))


def read_key_variable(name: str) -> str:
    """The key in an environment variable. Raises ConfigurationError if it is not set or
    malformed.
    """
    key = os.environ.get(name, "").strip()
    if not key:
        raise ConfigurationError(
            f"The environment variable {name!r} (api_key_variable) is not set."
        )
    return key


def check_key(key: str, place: str) -> str:
    """Return the key. Raises ConfigurationError if it is too short or not allowed in a header."""
    if len(key) < _LEAST or not all("!" <= character <= "~" for character in key):
        raise ConfigurationError(
            f"{place} holds no key of at least {_LEAST} printable characters without spaces.",
            hint=f"{_NEW} {place}",
        )
    return key


def is_loopback(host: str) -> bool:
    """True if `host` is this machine, judged by its text only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_url(url: str, *, has_key: bool, allow_insecure_key: bool) -> str:
    """Return a warning about `url`; empty for none.

    Raises:
        ConfigurationError: it has no host or holds a password, or a key would be sent unencrypted.
    """
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
    except ValueError as error:
        raise ConfigurationError(f"The option 'url' cannot be read: {error}.") from error
    if not host or parts.username is not None:
        raise ConfigurationError(
            "The option 'url' must name a host and hold no user or password.",
            hint="A key goes into api_key_file.",
        )
    if parts.scheme == "wss" or is_loopback(host):
        return ""
    if has_key and not allow_insecure_key:
        raise ConfigurationError(
            f"The API key would travel unencrypted to {host}.",
            hint="Use wss://, a tunnel, or allow_insecure_key = true.",
        )
    return (
        f"the connection to {host} is not encrypted: anyone on the path can read the images and "
        "change the robot's actions; use wss:// or a tunnel"
    )
