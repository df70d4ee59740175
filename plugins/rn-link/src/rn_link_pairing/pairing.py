"""The pairing of two machines: the hub shows a code, a person types it at the member.

Both prove that they know it before either trusts the other (see `pake`). The member's key never
leaves it: the hub gets a signed request.
"""

from __future__ import annotations

import errno
import json
import secrets
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from queue import Empty, Queue
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from rn_link.certificates import new_key, to_pem
from rn_link.machine import Machine, Peer, check_name, check_port
from rn_link_pairing.keeping import add_member, become_member, read_hub
from rn_link_pairing.pake import Exchange, PairingError, Sealer
from rn_link_pairing.wire import Wire, parse, to_bytes
from roboneuron import ConfigurationError

PAIRING_PORT = 7410
PAIRING_S = 300.0
ATTEMPTS = 3
"""Number of attempts; each tries one of a million codes."""
_ATTEMPT_S = 10.0
_MOST_SILENT = 64
"""Connections that have sent no message yet."""
_SLICE_S = 0.1
_CLOSED = (errno.EBADF, errno.EINVAL)
"""Errors of a listener that was closed."""
_PAUSE_S = 0.5
"""Pause after any other error of the listener [s]."""


def new_code() -> str:
    """Return six random digits."""
    return f"{secrets.randbelow(10**6):06}"


def open_listener(port: int) -> socket.socket:
    """Listen for members.

    Raises:
        ConfigurationError: the port is taken.
    """
    try:
        return socket.create_server(("0.0.0.0", port))
    except OSError as error:
        raise ConfigurationError(
            f"The link cannot listen on port {port}: {error.strerror or error}.",
            hint="Name another with --port, and `--join ADDRESS:PORT` on the other machine.",
        ) from error


class _Asking(NamedTuple):
    """A machine that has begun to pair; it has not tried a code yet."""

    connection: socket.socket
    wire: Wire
    address: str
    share: bytes


class _Waiting:
    """Accepts connections, and reads the first message of each on a thread of its own: one that
    sends nothing delays no other.
    """

    def __init__(
        self, listener: socket.socket, end_s: float, notify: Callable[[str], None]
    ) -> None:
        self._listener, self._end_s, self._notify = listener, end_s, notify
        self._asking: Queue[_Asking | OSError] = Queue()
        self._silent: deque[socket.socket] = deque()
        self._is_closed = threading.Event()
        self._thread = threading.Thread(target=self._accept, name="pairing", daemon=True)
        self._thread.start()

    def next(self) -> _Asking | None:
        """The next machine that asks; None at the end of the time.

        Raises:
            OSError: the listener cannot be used any more.
        """
        with suppress(Empty):
            found = self._asking.get(timeout=max(0.001, self._end_s - time.monotonic()))
            if isinstance(found, OSError):
                raise found
            return found
        return None

    def deadline_s(self) -> float:
        """By when an attempt that begins now has to be over [monotonic s]."""
        return min(self._end_s, time.monotonic() + _ATTEMPT_S)

    def close(self) -> None:
        """Accept no more, and close what has not asked yet."""
        self._is_closed.set()
        self._thread.join()
        for connection in list(self._silent):
            _shut(connection)
        with suppress(Empty):
            while True:
                left = self._asking.get_nowait()
                if not isinstance(left, OSError):
                    left.connection.close()

    def _accept(self) -> None:
        while not self._is_closed.is_set() and time.monotonic() < self._end_s:
            try:
                self._listener.settimeout(_SLICE_S)
                connection, (address, _) = self._listener.accept()
            except TimeoutError:
                continue
            except OSError as error:
                if error.errno in _CLOSED:
                    self._asking.put(error)
                    return
                # any other error concerns one connection, or passes: accept(2), "Error handling"
                self._notify(f"A machine cannot connect: {error}.")
                self._is_closed.wait(_PAUSE_S)
                continue
            self._silent.append(connection)
            if len(self._silent) > _MOST_SILENT:  # the one that has said nothing for longest
                _shut(self._silent.popleft())
            threading.Thread(target=self._read, args=(connection, address), daemon=True).start()

    def _read(self, connection: socket.socket, address: str) -> None:
        wire = Wire(connection, self.deadline_s())
        try:
            (share,) = wire.receive("share")
            asking = _Asking(connection, wire, address, to_bytes(share))
        except (PairingError, OSError) as error:
            if not self._is_closed.is_set():
                self._notify(f"{address}: {error}.")
            connection.close()
        else:
            self._asking.put(asking)
        finally:
            with suppress(ValueError):
                self._silent.remove(connection)


def _shut(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class PairingHub:
    """The hub's side: admits one machine.

    Args:
        folder: folder of the hub's link.
        name: name of the member.
        address: address of the member; None for that of its connection.
        days: validity of its certificate [days].
        notify: called with a sentence for the person about each failed attempt.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        *,
        address: str | None,
        days: int,
        notify: Callable[[str], None],
    ) -> None:
        self._folder = folder
        self._name = check_name(name)
        self._address = address
        self._days = days
        self._notify = notify
        self._hub = read_hub(folder)
        if self._name == self._hub.name:
            raise ConfigurationError(
                f"{name!r} is this machine, the hub itself.",
                hint="Name the machine that is to be added, such as gpu-1.",
            )

    def serve(self, listener: socket.socket, code: str, limit_s: float = PAIRING_S) -> Peer:
        """Pair with the machine that knows the code, and return it.

        Raises:
            ConfigurationError: none within `limit_s` [s] and ATTEMPTS.
        """
        waiting = _Waiting(listener, time.monotonic() + limit_s, self._notify)
        failed = 0
        with closing(waiting):
            while failed < ATTEMPTS:
                asking = waiting.next()
                if asking is None:
                    raise ConfigurationError(
                        f"No machine has paired within {limit_s:g} s.",
                        hint=f"Type `roboneuron link add {self._name}` again for a new code.",
                    )
                # one after the other: each tries a code
                asking.wire.begin(waiting.deadline_s())
                with closing(asking.connection):
                    try:
                        return self._admit(asking, code)
                    except (PairingError, OSError) as error:
                        self._notify(f"{asking.address}: {error}.")
                        failed += isinstance(error, WrongCodeError)
        raise ConfigurationError(
            f"{ATTEMPTS} attempts had a wrong code; the code is no longer valid.",
            hint=f"Type `roboneuron link add {self._name}` again for a new code.",
        )

    def _admit(self, asking: _Asking, code: str) -> Peer:
        wire = asking.wire
        exchange = Exchange(code, is_hub=True)
        to_hub, to_member = exchange.keys(asking.share)
        try:
            # from here on the other side can try a code, even without answering
            wire.send(share=exchange.share.hex())
            (sealed,) = wire.receive("sealed")
            content = to_hub.open(to_bytes(sealed))
        except (PairingError, OSError) as error:
            raise WrongCodeError(str(error)) from error
        request, port = parse(content, "request", "port")
        peer = Peer(self._address or asking.address, _port(port))
        certificate = add_member(
            self._folder, self._name, peer, _key(request), datetime.now(UTC), self._days
        )
        answer = {
            "hub": self._hub.name,
            "name": self._name,
            "certificate": to_pem(certificate).decode(),
            "trusted": (self._folder / "ca.pem").read_text(encoding="ascii"),
        }
        wire.send(sealed=to_member.seal(json.dumps(answer).encode()).hex())
        return peer


class WrongCodeError(PairingError):
    """An attempt that has tried a code."""


def _port(text: str) -> int:
    try:
        return check_port(int(text))
    except (ValueError, ConfigurationError) as error:
        raise PairingError("the member named no port") from error


def _key(request: str) -> ec.EllipticCurvePublicKey:
    """The key in a request that is signed with it."""
    try:
        found = x509.load_pem_x509_csr(request.encode())
        key = found.public_key()
        if isinstance(key, ec.EllipticCurvePublicKey) and found.is_signature_valid:
            return key
    except ValueError as error:
        raise PairingError("the member sent no request") from error
    raise PairingError("the member sent no request")


def join(
    folder: Path, address: str, port: int, code: str, own_port: int, limit_s: float = _ATTEMPT_S
) -> Machine:
    """Become a member of the link of the hub at that address, and return this machine's part.

    Raises:
        ConfigurationError: the hub does not answer, or the code is wrong.
    """
    key = new_key()
    deadline_s = time.monotonic() + limit_s
    try:
        with closing(socket.create_connection((address, port), limit_s)) as connection:
            wire = Wire(connection, deadline_s)
            to_hub, to_member = _agree(wire, code)
            facts = {"request": _request(key), "port": str(own_port)}
            wire.send(sealed=to_hub.seal(json.dumps(facts).encode()).hex())
            (sealed,) = wire.receive("sealed")
            content = to_member.open(to_bytes(sealed))
    except PairingError as error:
        raise ConfigurationError(
            f"{address} has not admitted this machine: {error}.",
            hint="Check the code; after a wrong one type `roboneuron link init --join` again.",
        ) from error
    except OSError as error:
        raise ConfigurationError(
            f"No hub answers at {address}, port {port}: {error.strerror or error}.",
            hint="Type `roboneuron link add NAME` on the hub first, and allow TCP to that port.",
        ) from error
    hub, name, *texts = parse(content, "hub", "name", "certificate", "trusted")
    certificate, trusted = (x509.load_pem_x509_certificate(one.encode()) for one in texts)
    machine = Machine(name=name, role="member", port=own_port, peers={hub: Peer(address)})
    become_member(folder, machine, key, certificate, trusted)
    return machine


def _agree(wire: Wire, code: str) -> tuple[Sealer, Sealer]:
    exchange = Exchange(code, is_hub=False)
    wire.send(share=exchange.share.hex())
    (share,) = wire.receive("share")
    return exchange.keys(to_bytes(share))


def _request(key: ec.EllipticCurvePrivateKey) -> str:
    builder = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([]))
    signed = builder.sign(key, hashes.SHA256())
    return signed.public_bytes(serialization.Encoding.PEM).decode()
