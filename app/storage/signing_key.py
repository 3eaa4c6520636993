"""The server's Ed25519 key, under which snapshots are signed."""

from __future__ import annotations

from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.errors import Unavailable
from app.storage.master_key import MASTER_KEY_BYTES, load_secret


def load_signing_key(path: Path) -> Ed25519PrivateKey:
    """The key in a file of 32 bytes that only its owner may read; created if there is none.

    Raises
    ------
    Unavailable
        The file is not a key. Vehicles hold the public key: a new one would make them refuse every snapshot.
    """
    seed = load_secret(path)
    if len(seed) != MASTER_KEY_BYTES:
        raise Unavailable(
            f"{path} is not a signing key: it has {len(seed)} bytes",
            field="signing_key_file",
            limit=f"{MASTER_KEY_BYTES} bytes",
            cure="restore the file that the vehicles' public key belongs to",
        )
    return Ed25519PrivateKey.from_private_bytes(seed)
