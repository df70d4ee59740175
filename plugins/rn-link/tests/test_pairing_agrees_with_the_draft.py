"""The key exchange compared with the published numbers of its draft.

Source: draft-irtf-cfrg-cpace-13, appendix B.1 (X25519, SHA-512).
"""

from __future__ import annotations

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey

from rn_link_pairing.pake import generator, session_key

CODE = b"Password"
PARTIES = bytes.fromhex("6f630b425f726573706f6e6465720b415f696e69746961746f72")
SESSION = bytes.fromhex("7e4b4791d6a8ef019b936c79fb7f2c57")
GENERATOR = bytes.fromhex("64e8099e3ea682cfdc5cb665c057ebb514d06bf23ebc9f743b51b82242327074")
SECRETS = tuple(
    map(
        bytes.fromhex,
        (
            "21b4f4bd9e64ed355c3eb676a28ebedaf6d8f17bdc365995b319097153044080",
            "848b0779ff415f0af4ea14df9dd1d3c29ac41d836c7808896c4eba19c51ac40a",
        ),
    )
)
SHARES = tuple(
    map(
        bytes.fromhex,
        (
            "1b02dad6dbd29a07b6d28c9e04cb2f184f0734350e32bb7e62ff9dbcfdb63d15",
            "20cda5955f82c4931545bcbf40758ce1010d7db4db2a907013d79c7a8fcf957f",
        ),
    )
)
POINT = bytes.fromhex("f97fdfcfff1c983ed6283856a401de3191ca919902b323c5f950c9703df7297a")
KEY = bytes.fromhex(
    "a051ee5ee2499d16da3f69f430218b8ea94a18a45b67f9e86495b382c33d14a5"
    "c38cecc0cc834f960e39e0d1bf7d76b9ef5d54eecc5e0f386c97ad12da8c3d5f"
)


def times(secret: bytes, point: bytes) -> bytes:
    key = X25519PrivateKey.from_private_bytes(secret)
    return key.exchange(X25519PublicKey.from_public_bytes(point))


def test_the_generator_is_that_of_the_draft() -> None:
    assert generator(CODE, PARTIES, SESSION) == GENERATOR


def test_shares_and_secret_point_are_those_of_the_draft() -> None:
    found = generator(CODE, PARTIES, SESSION)
    assert tuple(times(secret, found) for secret in SECRETS) == SHARES
    assert times(SECRETS[0], SHARES[1]) == times(SECRETS[1], SHARES[0]) == POINT


def test_the_session_key_is_that_of_the_draft() -> None:
    assert session_key(SESSION, POINT, SHARES[0], b"ADa", SHARES[1], b"ADb") == KEY
