"""The pairing of two machines: the hub shows a code, a person types it at the member.

Both prove that they know it before either trusts the other (see `pake`). The member's key never
leaves it: the hub gets a signed request.
"""

from __future__ import annotations

import errno
import json
import secrets
import socket
import time
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

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
_SESSION = 16
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

    def serve(self, listener: socket.socket, code: str, limit_s: float = PAIRING_S) -> Peer:
        """Pair with the machine that knows the code, and return it.

        Raises:
            ConfigurationError: none within `limit_s` [s] and ATTEMPTS.
        """
        end_s = time.monotonic() + limit_s
        failed = 0
        while failed < ATTEMPTS:
            listener.settimeout(max(0.001, end_s - time.monotonic()))
            try:
                connection, (address, _) = listener.accept()
            except TimeoutError:
                raise ConfigurationError(
                    f"No machine has paired within {limit_s:g} s.",
                    hint=f"Type `roboneuron link add {self._name}` again for a new code.",
                ) from None
            except OSError as error:
                if error.errno in _CLOSED or time.monotonic() > end_s:
                    raise
                # any other error concerns one connection, or passes: accept(2), "Error handling"
                self._notify(f"A machine cannot connect: {error}.")
                time.sleep(_PAUSE_S)
                continue
            with closing(connection):
                wire = Wire(connection, min(end_s, time.monotonic() + _ATTEMPT_S))
                try:
                    return self._admit(wire, code, address)
                except (PairingError, OSError) as error:
                    self._notify(f"{address}: {error}.")
                    # a connection that sends nothing has tried no code
                    failed += isinstance(error, WrongCodeError)
        raise ConfigurationError(
            f"{ATTEMPTS} attempts had a wrong code; the code is no longer valid.",
            hint=f"Type `roboneuron link add {self._name}` again for a new code.",
        )

    def _admit(self, wire: Wire, code: str, address: str) -> Peer:
        session, share = map(to_bytes, wire.receive("session", "share"))
        if len(session) != _SESSION:
            raise PairingError("the other side does not use this protocol")
        exchange = Exchange(code, session)
        to_hub, to_member = exchange.keys(share, is_hub=True)
        try:
            # from here on the other side can try a code, even without answering
            wire.send(share=exchange.share.hex())
            (sealed,) = wire.receive("sealed")
            content = to_hub.open(to_bytes(sealed))
        except (PairingError, OSError) as error:
            raise WrongCodeError(str(error)) from error
        request, port = parse(content, "request", "port")
        peer = Peer(self._address or address, _port(port))
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
    session = secrets.token_bytes(_SESSION)
    exchange = Exchange(code, session)
    wire.send(session=session.hex(), share=exchange.share.hex())
    (share,) = wire.receive("share")
    return exchange.keys(to_bytes(share), is_hub=False)


def _request(key: ec.EllipticCurvePrivateKey) -> str:
    builder = x509.CertificateSigningRequestBuilder().subject_name(x509.Name([]))
    signed = builder.sign(key, hashes.SHA256())
    return signed.public_bytes(serialization.Encoding.PEM).decode()
