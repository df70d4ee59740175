"""Authentication over a network: keys of `roboneuron link`, or a token."""

from __future__ import annotations

import hmac
import ipaddress
import logging
import os
import secrets
import socket
import ssl
from asyncio.trsock import TransportSocket
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import urlsplit

from rn_backend_openpi.options import PolicyOptions
from rn_backend_openpi.server_options import ListenOptions
from roboneuron import (
    ConfigurationError,
    ForeignDataError,
    MissingDependencyError,
    foreign,
    install_command,
)

if TYPE_CHECKING:
    from rn_link.machine import Machine

log = logging.getLogger(__name__)
LEAST_TOKEN = 16
MOST_TOKEN = 1024
_MOST_FILE = 4096
_LINK_FILES = ("link.json", "own.pem")
_PAIR = "Pair the machines with `roboneuron link`, the robot's machine being the hub."


class ServerAddress(NamedTuple):
    """A server that a robot connects to.

    Attributes:
        url: its address, "ws://host:port/path".
        host, port: the same.
        context: None for an unencrypted connection.
        token: token that the robot sends; empty with keys.
        warning: about a connection that others can read; empty for none.
    """

    url: str
    host: str
    port: int
    context: ssl.SSLContext | None
    token: str = ""
    warning: str = ""


def is_loopback(host: str) -> bool:
    """True if data sent to or from this host certainly stays on this machine."""
    if host == "localhost":
        return True
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False


def read_token(path: Path) -> str:
    """The token in a file, without the final line break.

    Raises:
        ConfigurationError: it cannot be read, is readable by others, or holds no token of 16 to
            1024 printable ASCII characters.
    """
    try:
        text = foreign.read_text(path, most_bytes=_MOST_FILE, is_secret=True).strip()
    except (FileNotFoundError, ForeignDataError) as error:
        raise ConfigurationError(f"The token file {path} cannot be read: {error}.") from error
    is_printable = all("!" <= character <= "~" for character in text)
    if not is_printable or not LEAST_TOKEN <= len(text) <= MOST_TOKEN:
        raise ConfigurationError(
            f"The token in {path} has {len(text)} characters, expected {LEAST_TOKEN} to "
            f"{MOST_TOKEN} printable ones without spaces.",
            hint="Make one with: umask 077; python -c 'import secrets; "
            f"print(secrets.token_urlsafe(32))' > {path}",
        )
    return text


def make_token(path: Path) -> str:
    """The token in a file, which is created if missing; raises as `read_token`."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        return read_token(path)
    except OSError as error:
        raise ConfigurationError(f"The token file {path} cannot be made: {error}.") from error
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        file.write(secrets.token_urlsafe(32) + "\n")
    return read_token(path)


def has_link_keys(options: PolicyOptions) -> bool:
    """True if the connection uses the keys of `roboneuron link`."""
    return options.address is not None and not (options.token_file or options.api_key_variable)


def place_of(options: PolicyOptions) -> ServerAddress:
    """Address and TLS context of a robot's server at a URL or an address.

    Raises:
        ConfigurationError: the URL has no host or holds a password, the machines are not paired, or
            a token would be sent unencrypted.
        MissingDependencyError: rn-link is not installed.
    """
    if has_link_keys(options):
        return _linked_place(options)
    url, token = options.server_url, _token_of(options)
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ConfigurationError(f"The option 'url' cannot be read: {error}.") from error
    if not host or parts.username is not None:
        raise ConfigurationError(
            "The option 'url' must name a host and hold no user or password.",
            hint="A key goes into token_file.",
        )
    if parts.scheme == "wss":
        return ServerAddress(url, host, port or 443, _client_context(options), token)
    place = ServerAddress(url, host, port or 80, None, token)
    if is_loopback(host):
        return place
    if token and not options.allow_insecure_key:
        raise ConfigurationError(
            f"A token is not sent unencrypted to {host}.",
            hint="Use wss:// or ca_file, a tunnel, or allow_insecure_key = true. Of `roboneuron "
            f"policy serve`: {_PAIR}",
        )
    return place._replace(
        warning=f"the connection to {host} is not encrypted: anyone on the path can read the "
        "images and change the robot's actions; use wss:// or a tunnel"
    )


def _token_of(options: PolicyOptions) -> str:
    """The token of the options; empty for none. Raises ConfigurationError."""
    if options.token_file is not None:
        return read_token(options.token_file)
    if options.api_key_variable is None:
        return ""
    key = os.environ.get(options.api_key_variable, "").strip()
    if not key:
        raise ConfigurationError(
            f"The environment variable {options.api_key_variable!r} (api_key_variable) is not set.",
            hint="Set it, or name a file with token_file.",
        )
    return key


def _client_context(options: PolicyOptions) -> ssl.SSLContext:
    """Trust in the authority that the options name, or in the system's. Raises ConfigurationError
    if its file holds no certificate.
    """
    try:
        return ssl.create_default_context(cafile=options.ca_file)
    except OSError as error:
        raise ConfigurationError(
            f"{options.ca_file} holds no certificate: {error}.",
            hint="ca_file is a PEM file.",
        ) from error


def link_stamps() -> Sequence[object]:
    """A value that changes with this machine's keys or peers; empty without rn-link."""
    try:
        from rn_link.machine import link_folder
    except ModuleNotFoundError:
        return ()
    stamps = []
    for name in _LINK_FILES:
        with suppress(OSError):
            stamps.append((name, (link_folder() / name).stat().st_mtime_ns))
    return tuple(stamps)


def _linked_place(options: PolicyOptions) -> ServerAddress:
    assert options.address is not None
    named, _, port = options.address.rpartition(":")
    host = named.strip("[]")
    folder, machine = _link()
    from rn_link.tls import tls_context

    found = [name for name, peer in machine.peers.items() if host in (name, peer.address)]
    if machine.role != "hub" or not found:
        known = ", ".join(f"{name} ({peer.address})" for name, peer in machine.peers.items())
        raise ConfigurationError(
            f"This machine is the {machine.role} of its link and is paired with {known or 'none'}; "
            f"{host!r} cannot be reached with its keys.",
            hint=f"Name a paired machine. {_PAIR}",
        )
    context = tls_context(machine, folder, found[0])
    return ServerAddress(options.server_url, machine.peers[found[0]].address, int(port), context)


def _link() -> tuple[Path, Machine]:
    """Folder and contents of this machine's link. Raises MissingDependencyError,
    ConfigurationError.
    """
    try:
        from rn_link.machine import link_folder, read_machine
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            "The keys of `roboneuron link` need rn-link, which is not installed.",
            hint=f"Run: {install_command('rn-link')}. Or use a token (token_file).",
        ) from error
    folder = link_folder()
    machine = read_machine(folder)
    if machine is None:
        raise ConfigurationError(
            "This machine has no link.", hint=f"{_PAIR} Or use a token (token_file)."
        )
    return folder, machine


class Guard:
    """Admission to a server. Raises ConfigurationError for unsafe options.

    Args:
        options: options of the server.
    """

    def __init__(self, options: ListenOptions) -> None:
        self._options = options
        self.token = ""
        self._stamps: Sequence[object] = ()
        self._context: ssl.SSLContext | None = None
        if options.keys != "link":
            _check_listening(options)
            if options.token_file is not None:
                self.token = make_token(options.token_file)
            self._context = _server_context(options)
        else:
            self._stamps = link_stamps()
            self._context = _member_context()

    def has_changed(self) -> bool:
        """Load changes made by `roboneuron link`; returns True if there were any. Machines that are
        no longer paired are refused from now on.
        """
        if self._options.keys != "link" or (stamps := link_stamps()) == self._stamps:
            return False
        self._stamps = stamps
        try:
            self._context = _member_context()
        except ConfigurationError:
            self._context = None
        return True

    @property
    def context(self) -> ssl.SSLContext | None:
        """TLS of new connections; None for connections in clear.

        Raises:
            ConnectionError: this machine is no longer paired with any.
        """
        if self._context is None and self._options.keys == "link":
            raise ConnectionError("this machine is not paired with any")
        return self._context

    def is_admitted(self, shown: Sequence[str]) -> bool:
        """True if these headers `Authorization` hold the token, or none is needed."""
        given, wanted = (
            text.encode(errors="replace") for text in (" ".join(shown), authorization(self.token))
        )
        return not self.token or hmac.compare_digest(given, wanted)


def authorization(token: str) -> str:
    """The header `Authorization` with a token, as openpi's clients send it."""
    return f"Api-Key {token}"


def _check_listening(options: ListenOptions) -> None:
    """Raise ConfigurationError if other machines could connect without a token or unencrypted,
    unless that is wanted.
    """
    needed = {"token_file": options.token_file, "certificate": options.certificate}
    lacks = " and ".join(name for name, given in needed.items() if given is None)
    if not lacks or is_loopback(options.host):
        return
    if not options.insecure:
        raise ConfigurationError(
            f"{options.host} can be reached from other machines, and there is no {lacks}: a "
            "token would be sent unencrypted, or anybody could read the images.",
            hint=f"Set both, listen on 127.0.0.1, choose insecure = true, or use keys = "
            f"'link'. {_PAIR}",
        )
    log.warning("%s can be reached from other machines without %s.", options.host, lacks)


def _server_context(options: ListenOptions) -> ssl.SSLContext | None:
    if options.certificate is None:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        foreign.read_bytes(options.key or options.certificate, is_secret=True)
        context.load_cert_chain(options.certificate, options.key)
    except (OSError, ForeignDataError) as error:
        key = f" and {options.key}" if options.key is not None else ""
        raise ConfigurationError(
            f"The certificate {options.certificate}{key} cannot be used: {error}."
        ) from error
    return context


def _member_context() -> ssl.SSLContext:
    folder, machine = _link()
    from rn_link.tls import tls_context

    if machine.role != "member" or not machine.peers:
        raise ConfigurationError(
            f"This machine is the {machine.role} of its link; robots connect to members.",
            hint=_PAIR,
        )
    (hub,) = machine.peers
    return tls_context(machine, folder, hub)


def tune(connected: socket.socket | TransportSocket, silent_s: float) -> None:
    """Send without delay, and detect within `silent_s` that the peer has disappeared."""
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        (socket.TCP_KEEPIDLE, 1),
        (socket.TCP_KEEPINTVL, 1),
        (socket.TCP_KEEPCNT, max(int(silent_s), 1)),
        (socket.TCP_USER_TIMEOUT, int(silent_s * 1e3)),
    ):
        connected.setsockopt(socket.IPPROTO_TCP, option, value)
