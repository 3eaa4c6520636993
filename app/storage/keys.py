"""Keys of the server: the master key, and the keys that sign snapshots."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.errors import InvalidParameter, Unavailable
from app.markers.snapshot import MAX_KEYS

# === The server's own key, under which secrets of agencies are stored.


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


# === The server's Ed25519 keys: one signs snapshots; during a rotation vehicles trust a second one as well.


_SEED_BYTES = 32  # RFC 8032, section 5.1.5


def load_signing_keys(path: Path) -> tuple[Ed25519PrivateKey, ...]:
    """The keys in a file that only its owner may read; created with one key if there is none. The first key signs.

    Raises
    ------
    Unavailable
        The file does not consist of one or two keys of 32 bytes. It is not replaced by a new one: vehicles hold the
        public keys, and would refuse every snapshot.
    """
    return tuple(Ed25519PrivateKey.from_private_bytes(seed) for seed in _seeds(path))


def add_signing_key(path: Path) -> None:
    """Add a new key, which does not sign yet.

    Raises
    ------
    InvalidParameter
        There are two keys already.
    """
    seeds = _seeds(path)
    if len(seeds) == MAX_KEYS:
        raise InvalidParameter(
            f"{path} has two keys already", limit=f"{MAX_KEYS} keys", cure="run waymark snapshot rotate remove first"
        )
    _replace(path, [*seeds, secrets.token_bytes(_SEED_BYTES)])


def switch_signing_keys(path: Path) -> None:
    """Let the other of two keys sign."""
    _replace(path, _both(path)[::-1])


def remove_signing_key(path: Path) -> None:
    """Remove the key that does not sign."""
    _replace(path, _both(path)[:1])


def _both(path: Path) -> list[bytes]:
    seeds = _seeds(path)
    if len(seeds) != MAX_KEYS:
        raise InvalidParameter(f"{path} has only one key", cure="run waymark snapshot rotate add first")
    return seeds


def _seeds(path: Path) -> list[bytes]:
    content = load_secret(path)
    if len(content) not in (_SEED_BYTES, MAX_KEYS * _SEED_BYTES):
        raise Unavailable(
            f"{path} is not a file of signing keys: it has {len(content)} bytes",
            field="signing_key_file",
            limit=f"one or two keys of {_SEED_BYTES} bytes",
            cure="restore the file that the vehicles' public keys belong to",
        )
    return [content[start : start + _SEED_BYTES] for start in range(0, len(content), _SEED_BYTES)]


def _replace(path: Path, seeds: list[bytes]) -> None:
    """Write the file so that it is either the old or the new one after a loss of power."""
    fresh = path.with_name(path.name + ".new")
    fresh.unlink(missing_ok=True)
    with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(b"".join(seeds))
        file.flush()
        os.fsync(file.fileno())
    fresh.replace(path)
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
