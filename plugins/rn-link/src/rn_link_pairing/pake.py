"""A strong key from a six-digit code by SPAKE2; each attempt can try one code.

SPAKE2 is that of the library `spake2`, which magic-wormhole uses too. It does not compute in
constant time: its author says what that may tell about the code, which is valid for five minutes
and three attempts.
"""

from __future__ import annotations

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from spake2 import SPAKE2_A, SPAKE2_B, SPAKEError
from spake2.ed25519_basic import NotOnCurve

_MEMBER, _HUB = b"roboneuron link member", b"roboneuron link hub"
_SHARE = 33
"""Length of a share: the side and a point."""
_NONCE = bytes(12)
"""Constant nonce: each key seals one message."""


class PairingError(ValueError):
    """The other side does not know the code, or does not use this protocol."""


class Exchange:
    """One side of one attempt.

    Args:
        code: the code typed by the person or shown by the hub.
        is_hub: it is the hub's side.

    Attributes:
        share: for the other side.
    """

    def __init__(self, code: str, *, is_hub: bool) -> None:
        side = SPAKE2_B if is_hub else SPAKE2_A
        self._side = side(code.encode(), idA=_MEMBER, idB=_HUB)
        self.share: bytes = self._side.start()

    def keys(self, other: bytes) -> tuple[Sealer, Sealer]:
        """Return the sealers of the member's message and the hub's.

        Raises:
            PairingError: the share of the other side is invalid.
        """
        if len(other) != _SHARE:
            raise PairingError("the other side sent no valid share")
        try:
            material = self._side.finish(other)
        except (SPAKEError, NotOnCurve, ValueError) as error:
            raise PairingError("the other side sent no valid share") from error
        return Sealer(material, b"member to hub"), Sealer(material, b"hub to member")


class Sealer:
    """Seals and opens the only message of one direction."""

    def __init__(self, material: bytes, direction: bytes) -> None:
        key = HKDF(hashes.SHA256(), 32, None, b"roboneuron link 2, " + direction).derive(material)
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
