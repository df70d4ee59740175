"""CPace: a strong key from a six-digit code; each attempt can try one code.

Source: draft-irtf-cfrg-cpace, group X25519 with SHA-512; the map is Elligator 2 (RFC 9380, 6.7.1).
"""

from __future__ import annotations

import hashlib

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

PARTIES = b"\x06member\x03hub"
_DOMAIN = b"CPace255"
_PRIME = 2**255 - 19
_A = 486662
_BLOCK = 128
_NONCE = bytes(12)
"""Constant nonce: each key seals one message."""


class PairingError(ValueError):
    """The other side does not know the code, or does not use this protocol."""


def generator(code: bytes, parties: bytes, session: bytes) -> bytes:
    """The u coordinate of the curve's point for the code."""
    padding = max(0, _BLOCK - 1 - len(_framed(code)) - len(_framed(_DOMAIN)))
    parts = (_DOMAIN, code, bytes(padding), parties, session)
    digest = hashlib.sha512(b"".join(map(_framed, parts))).digest()[:32]
    element = (int.from_bytes(digest, "little") & (2**255 - 1)) % _PRIME
    candidate = -_A * pow(1 + 2 * element * element, -1, _PRIME) % _PRIME
    on_curve = candidate * (candidate * candidate + _A * candidate + 1)
    is_square = pow(on_curve, (_PRIME - 1) // 2, _PRIME) in (0, 1)
    u = candidate if is_square else (-candidate - _A) % _PRIME
    return u.to_bytes(32, "little")


def _framed(part: bytes) -> bytes:
    """Prefix a part with its length; lengths beyond 127, which take more bytes in the draft, are
    refused.
    """
    if len(part) > 127:
        raise PairingError("a part of the pairing is too long")
    return bytes([len(part)]) + part


def session_key(session: bytes, secret: bytes, *shares: bytes) -> bytes:
    """Return the draft's ISK; `shares` are the member's, its data, the hub's and its data."""
    parts = (_DOMAIN + b"_ISK", session, secret, *shares)
    return hashlib.sha512(b"".join(map(_framed, parts))).digest()


class Exchange:
    """One side of one attempt.

    Args:
        code: the code typed by the person or shown by the hub.
        session: random bytes from the member.
    """

    def __init__(self, code: str, session: bytes) -> None:
        self._session = session
        self._secret = X25519PrivateKey.generate()
        self._generator = generator(code.encode(), PARTIES, session)
        self.share = self._times(self._generator)

    def _times(self, point: bytes) -> bytes:
        try:
            return self._secret.exchange(X25519PublicKey.from_public_bytes(point))
        except ValueError as error:  # a point of small order, which would determine the key
            raise PairingError("the other side sent no valid share") from error

    def keys(self, other: bytes, *, is_hub: bool) -> tuple[Sealer, Sealer]:
        """Return the sealers of the member's message and the hub's.

        Raises:
            PairingError: the share of the other side is invalid.
        """
        secret = self._times(other)
        member, hub = (other, self.share) if is_hub else (self.share, other)
        material = session_key(self._session, secret, member, b"", hub, b"")
        return Sealer(material, b"member to hub"), Sealer(material, b"hub to member")


class Sealer:
    """Seals and opens the only message of one direction."""

    def __init__(self, material: bytes, direction: bytes) -> None:
        key = HKDF(hashes.SHA256(), 32, None, b"roboneuron link 1, " + direction).derive(material)
        self._cipher = ChaCha20Poly1305(key)

    def seal(self, content: bytes) -> bytes:
        """Encrypt and authenticate."""
        return self._cipher.encrypt(_NONCE, content, None)

    def open(self, sealed: bytes) -> bytes:
        """Decrypt. Raises PairingError: the other side does not know the code."""
        try:
            return self._cipher.decrypt(_NONCE, sealed, None)
        except InvalidTag as error:
            raise PairingError("the code is not that of the other machine") from error
