"""What robots sign, and how it is checked: Ed25519."""

from __future__ import annotations

from typing import Any

from engram.errors import InputError, MissingExtraError

KEY_BYTES = 32
SIGNATURE_BYTES = 64


def enrolment_text(code: str) -> bytes:
    """What a robot signs to enrol: that it holds the key whose public half it sends."""
    return b"engram enrol " + code.encode()


def token_text(robot: str, nonce: str) -> bytes:
    """What a robot signs to get a token."""
    return f"engram token {robot} {nonce}".encode()


def check_signature(public_key: bytes, signature: bytes, text: bytes) -> None:
    """Refuses a signature that is not of this key.

    Raises:
        InputError: it is not.
    """
    from cryptography.exceptions import InvalidSignature
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

    try:
        Ed25519PublicKey.from_public_bytes(public_key).verify(signature, text)
    except (InvalidSignature, ValueError) as error:
        raise InputError("the signature is not of this key") from error


class Signer:
    """A robot's key pair.

    Args:
        private_key: 32 bytes; `new_key` makes them.
    """

    def __init__(self, private_key: bytes) -> None:
        self._key = _ed25519().Ed25519PrivateKey.from_private_bytes(private_key)

    @staticmethod
    def new_key() -> bytes:
        """A new private key, 32 bytes."""
        made: bytes = _ed25519().Ed25519PrivateKey.generate().private_bytes_raw()
        return made

    @property
    def public_key(self) -> bytes:
        """32 bytes."""
        found: bytes = self._key.public_key().public_bytes_raw()
        return found

    def sign(self, text: bytes) -> bytes:
        """The signature, 64 bytes."""
        made: bytes = self._key.sign(text)
        return made


def _ed25519() -> Any:
    """The module; the key pairs of robots alone need it."""
    try:
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise MissingExtraError(
            "keys of robots need cryptography: pip install 'engram-localisation[agent]'"
        ) from error
    return ed25519
