"""Authentication over a network: keys of `roboneuron link`, or a token."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import secrets
import socket
import ssl
from asyncio.trsock import TransportSocket
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from rn_backend_openpi.shared_options import ListenOptions, SharedOptions
from roboneuron import ConfigurationError, MissingDependencyError, install_command

if TYPE_CHECKING:
    from rn_link.machine import Machine

LEAST_TOKEN = 16
MOST_TOKEN = 1024
_LINK_FILES = ("link.json", "own.pem", "own.key")
_PAIR = "Pair the machines with `roboneuron link`, the robot's machine being the hub."


class ServerAddress(NamedTuple):
    """A server that a robot connects to.

    Attributes:
        host, port: its address.
        context: None for an unencrypted connection over loopback.
        token: token that the robot sends; empty with keys.
    """

    host: str
    port: int
    context: ssl.SSLContext | None
    token: str


def is_loopback(host: str) -> bool:
    """True if data sent to or from this host certainly stays on this machine."""
    if host == "localhost":
        return True
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return False


def read_token(path: Path) -> str:
    """The token in a file.

    Raises:
        ConfigurationError: it is missing, too short, or readable by others.
    """
    try:
        text = path.read_text(encoding="ascii").strip()
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"The token file {path} cannot be read: {error}.") from error
    if mode & 0o077:
        raise ConfigurationError(
            f"Others may read the token file {path}.", hint=f"Type `chmod 600 {path}`."
        )
    if not LEAST_TOKEN <= len(text) <= MOST_TOKEN:
        raise ConfigurationError(
            f"The token in {path} has {len(text)} characters, expected {LEAST_TOKEN} to "
            f"{MOST_TOKEN}."
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


def is_same_token(one: str, other: str) -> bool:
    """Compare in constant time."""
    first, second = (hashlib.sha256(text.encode()).digest() for text in (one, other))
    return hmac.compare_digest(first, second)


def place_of(options: SharedOptions) -> ServerAddress:
    """Address and TLS context of a robot's server.

    Raises:
        ConfigurationError: the machines are not paired, or a token would be sent unencrypted.
        MissingDependencyError: rn-link is not installed.
    """
    assert options.address is not None
    host, _, port = options.address.rpartition(":")
    if options.token_file is None:
        return _linked_place(host, int(port))
    token = read_token(options.token_file)
    if options.ca is not None:
        context = _context(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname = False  # the authority in the file issues only for this server
        try:
            context.load_verify_locations(options.ca)
        except OSError as error:
            raise ConfigurationError(f"{options.ca} holds no certificate: {error}.") from error
        return ServerAddress(host, int(port), context, token)
    if not is_loopback(host):
        raise ConfigurationError(
            f"A token is not sent unencrypted to {host}.",
            hint=f"Name the server's certificate with `ca`. Better: {_PAIR}",
        )
    return ServerAddress(host, int(port), None, token)


def link_stamps() -> Sequence[object]:
    """A value that changes with this machine's keys or peers; empty without rn-link."""
    try:
        from rn_link.machine import link_folder
    except ModuleNotFoundError:
        return ()
    folder = link_folder()
    paths = [folder / name for name in _LINK_FILES] + sorted(folder.glob("peers/*.issuer.pem"))
    return tuple((path.name, _stamp(path)) for path in paths)


def _stamp(path: Path) -> int:
    with suppress(OSError):
        return path.stat().st_mtime_ns
    return 0


def _linked_place(host: str, port: int) -> ServerAddress:
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
    try:
        context = tls_context(machine, folder, found[0])
    except OSError as error:
        raise ConfigurationError(f"The keys of the link cannot be used: {error}.") from error
    return ServerAddress(machine.peers[found[0]].address, port, context, "")


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


def _context(protocol: int) -> ssl.SSLContext:
    context = ssl.SSLContext(protocol)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    return context


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
        if options.keys == "token":
            assert options.token_file is not None
            if options.certificate is None and not is_loopback(options.host):
                raise ConfigurationError(
                    f"A token would be sent unencrypted to {options.host}.",
                    hint="Name certificate and key in [listen], listen on 127.0.0.1, or use keys = "
                    f"'link'. {_PAIR}",
                )
            self.token = make_token(options.token_file)
            if options.certificate is not None:
                self._context = _context(ssl.PROTOCOL_TLS_SERVER)
                try:
                    self._context.load_cert_chain(options.certificate, options.key)
                except OSError as error:
                    raise ConfigurationError(
                        f"{options.certificate} and {options.key} cannot be used: {error}."
                    ) from error
        else:
            self._stamps = link_stamps()
            self._context = _member_context()

    def has_changed(self) -> bool:
        """Load changes made by `roboneuron link`; returns True if there were any. Machines that are
        no longer paired are refused from now on.
        """
        if self._options.keys == "token" or (stamps := link_stamps()) == self._stamps:
            return False
        self._stamps = stamps
        try:
            self._context = _member_context()
        except (ConfigurationError, OSError):
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
        return not self.token or is_same_token(" ".join(shown), authorization(self.token))


def authorization(token: str) -> str:
    """The header `Authorization` with a token, as openpi's clients send it."""
    return f"Api-Key {token}"


def _member_context() -> ssl.SSLContext:
    folder, machine = _link()
    from rn_link.tls import tls_context

    if machine.role != "member" or not machine.peers:
        raise ConfigurationError(
            f"This machine is the {machine.role} of its link; robots connect to members.",
            hint=_PAIR,
        )
    (hub,) = machine.peers
    try:
        return tls_context(machine, folder, hub)
    except OSError as error:
        raise ConfigurationError(f"The keys of the link cannot be used: {error}.") from error


def valid_until(tls: ssl.SSLObject | None) -> datetime | None:
    """Expiry of the peer's certificate; None without one."""
    shown = None if tls is None else tls.getpeercert()
    if not shown:
        return None
    return datetime.fromtimestamp(ssl.cert_time_to_seconds(str(shown["notAfter"])), UTC)


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
