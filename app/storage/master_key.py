"""The server's own key, under which secrets of agencies are stored."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from app.errors import Unavailable

MASTER_KEY_BYTES = 32


def load_master_key(path: Path) -> bytes:
    """The key in a file that only its owner may read; created if there is none.

    Raises
    ------
    Unavailable
        The file is not a key. Making a new one would lose every secret under the old.
    """
    key = load_secret(path)
    if len(key) != MASTER_KEY_BYTES:
        raise Unavailable(
            f"{path} is not a master key: it has {len(key)} bytes",
            field="master_key_file",
            limit=f"{MASTER_KEY_BYTES} bytes",
            cure="restore the file that was made with the database; without it keys of CERPMs cannot be read",
        )
    return key


def load_secret(path: Path) -> bytes:
    """Content of a file that only its owner may read; 32 random bytes are written if there is none."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except FileExistsError:
        return path.read_bytes()
    secret = secrets.token_bytes(MASTER_KEY_BYTES)
    with os.fdopen(descriptor, "wb") as file:
        file.write(secret)
        file.flush()
        os.fsync(file.fileno())
    return secret
