"""The pairing of two machines: the hub shows a code, a person types it at the member.

Both derive a key from the code by SPAKE2 (the library `spake2`, which magic-wormhole uses too) and
exchange their certificates encrypted with it (Fernet, of `cryptography`). A machine without the
code learns nothing and changes nothing; each attempt tries one code. The library does not compute
in constant time: its author says what that may tell about a code, which is valid for five minutes
and three attempts. Messages are lines; keys never leave their machines.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import socket
from base64 import urlsafe_b64encode
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

from cryptography.fernet import Fernet, InvalidToken
from spake2 import SPAKE2_A, SPAKE2_B, SPAKEError
from spake2.ed25519_basic import NotOnCurve

from rn_link.keys import (
    add_peer,
    check_new_peer,
    make_machine,
    new_identity,
    own_certificate,
    remove_peer,
    to_certificate,
)
from rn_link.machine import Machine, Peer
from rn_link.tls import Handshakes
from roboneuron import ConfigurationError, ForeignDataError, foreign

PAIRING_PORT = 7410
PAIRING_S = 300.0
ATTEMPTS = 3
"""Number of attempts; each tries one of a million codes."""
_ATTEMPT_S = 10.0
_MOST_BYTES = 16_384
_SHARE_BYTES = 33
"""A share of SPAKE2: the side and a point."""
_SIDES = {"idA": b"roboneuron link member", "idB": b"roboneuron link hub"}
_FOREIGN = "the other side does not use this protocol"


class PairingError(ValueError):
    """The other side does not know the code, or does not use this protocol."""


def new_code() -> str:
    """Return six random digits."""
    return f"{secrets.randbelow(10**6):06}"


def open_listener(port: int = PAIRING_PORT) -> socket.socket:
    """Listen for members.

    Raises:
        ConfigurationError: the port is taken.
    """
    try:
        return socket.create_server(("0.0.0.0", port))
    except OSError as error:
        raise ConfigurationError(
            f"The link cannot listen on port {port}: {error.strerror or error}.",
            hint="End the process that uses that port.",
        ) from error


class PairingHub:
    """The hub's side: admits one machine.

    Each connection is served on its own, so that none delays another.

    Args:
        folder: folder of the hub's link.
        name: name of the member.
        code: the code that the member's person types.
        notify: called with a sentence for the person about each failed attempt.

    Raises:
        ConfigurationError: as `check_new_peer`.
    """

    def __init__(self, folder: Path, name: str, code: str, notify: Callable[[str], None]) -> None:
        self._folder = folder
        self._name = name
        self._code = code
        self._notify = notify
        self._hub = check_new_peer(folder, name)
        self._handshakes = Handshakes()
        self._begun = 0
        self._ended = 0

    async def serve(self, listener: socket.socket, limit_s: float = PAIRING_S) -> str:
        """Pair with the machine that knows the code, and return its address.

        Raises:
            ConfigurationError: none within `limit_s` [s] and ATTEMPTS.
        """
        self._admitted: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        server = await asyncio.start_server(self._answer, sock=listener, limit=_MOST_BYTES)
        try:
            return await asyncio.wait_for(self._admitted, limit_s)
        except TimeoutError as error:
            raise self._over(f"No machine has paired within {limit_s:g} s.") from error
        finally:
            server.close()
            self._handshakes.end()

    def _over(self, sentence: str) -> ConfigurationError:
        again = f"Type `roboneuron link add {self._name}` again for a new code."
        return ConfigurationError(sentence, hint=again)

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # who sends nothing, or something else than a share, has tried no code
        with self._handshakes.begun(writer), closing(writer), suppress(PairingError, OSError):
            async with asyncio.timeout(_ATTEMPT_S):
                theirs = await _receive(reader)
            if self._begun == ATTEMPTS:
                return
            exchange = SPAKE2_B(self._code.encode(), **_SIDES)
            share = exchange.start()
            cipher = _agree(exchange, theirs)
            # from here on the other side can try a code, even without answering
            self._begun += 1
            await self._attempt(cipher, share, reader, writer)

    async def _attempt(
        self,
        cipher: Fernet,
        share: bytes,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        address = str(writer.get_extra_info("peername", ("?",))[0])
        try:
            async with asyncio.timeout(_ATTEMPT_S):
                writer.write(share.hex().encode() + b"\n")
                (sent,) = _open(cipher, await _receive(reader), "certificate")
                own = own_certificate(self._folder)
                add_peer(self._folder, self._name, Peer(address, to_certificate(sent)))
                try:
                    names = {"hub": self._hub.name, "name": self._name}
                    writer.write(_seal(cipher, **names, certificate=own))
                    writer.close()
                    await writer.wait_closed()
                except (OSError, asyncio.CancelledError):
                    remove_peer(self._folder, self._name)
                    raise
            self._admitted.set_result(address)
        except (ValueError, ConfigurationError, OSError) as error:
            self._notify(f"{address}: {str(error) or 'no answer in time'}.")
        finally:
            self._ended += 1
            if self._ended == ATTEMPTS and not self._admitted.done():
                told = f"{ATTEMPTS} attempts had a wrong code; the code is no longer valid."
                self._admitted.set_exception(self._over(told))


async def join(folder: Path, address: str, code: str, port: int = PAIRING_PORT) -> Machine:
    """Become a member of the link of the hub at that address, and return this machine's part.

    Raises:
        ConfigurationError: the hub does not answer, the code is wrong, or this machine has a link.
        OSError: the files cannot be written.
    """
    identity = new_identity()
    try:
        async with asyncio.timeout(_ATTEMPT_S):
            reader, writer = await asyncio.open_connection(address, port, limit=_MOST_BYTES)
            with closing(writer):
                exchange = SPAKE2_A(code.encode(), **_SIDES)
                writer.write(exchange.start().hex().encode() + b"\n")
                cipher = _agree(exchange, await _receive(reader))
                writer.write(_seal(cipher, certificate=to_certificate(identity)))
                sealed = await _receive(reader)
        hub, name, sent = _open(cipher, sealed, "hub", "name", "certificate")
        peers = {hub: Peer(address, to_certificate(sent))}
    except ValueError as error:
        raise ConfigurationError(
            f"{address} has not admitted this machine: {error}.",
            hint="Check the code; after a wrong one type `roboneuron link init --join` again.",
        ) from error
    except OSError as error:
        raise ConfigurationError(
            f"No hub answers at {address}, port {port}: {error.strerror or error or 'no answer'}.",
            hint="Type `roboneuron link add NAME` on the hub first, and allow TCP to that port.",
        ) from error
    machine = Machine(name=name, role="member", peers=peers)
    make_machine(folder, machine, identity)
    return machine


def _agree(exchange: SPAKE2_A | SPAKE2_B, share: bytes) -> Fernet:
    """The cipher of both sides, if they have the same code."""
    try:
        other = bytes.fromhex(share.decode())
        if len(other) == _SHARE_BYTES:
            return Fernet(urlsafe_b64encode(exchange.finish(other)))
    except (SPAKEError, NotOnCurve, ValueError) as error:
        raise PairingError("the other side sent no valid share") from error
    raise PairingError("the other side sent no valid share")


async def _receive(reader: asyncio.StreamReader) -> bytes:
    try:
        line = await reader.readline()
    except ValueError as error:  # longer than the limit
        raise PairingError(_FOREIGN) from error
    if not line:
        raise PairingError("the other side has closed the connection")
    return line.strip()


def _seal(cipher: Fernet, **fields: str) -> bytes:
    return cipher.encrypt(json.dumps(fields).encode()) + b"\n"


def _open(cipher: Fernet, sealed: bytes, *names: str) -> list[str]:
    """The fields of the two sides have other names, so that none can send a message back."""
    try:
        content = cipher.decrypt(sealed)
    except InvalidToken as error:
        raise PairingError("the code is not that of the other machine") from error
    return parse(content, *names)


def parse(content: bytes, *names: str) -> list[str]:
    """Return text fields of a JSON object; raises PairingError."""
    try:
        fields = foreign.decode_json(content, "a message", most_bytes=_MOST_BYTES)
        return [foreign.text(foreign.field(fields, name), name, _MOST_BYTES) for name in names]
    except ForeignDataError as error:
        raise PairingError(_FOREIGN) from error
