"""Keys of agencies: from one each, the keys of its CERPMs are derived. They never leave the server in clear."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from datetime import datetime

import sqlalchemy as sa
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from app.errors import Unavailable
from app.registry import markers

AGENCY_KEY_BYTES = 32
_NONCE_BYTES = 12


class AgencySecrets:
    """Wraps and unwraps keys of agencies, AES-256-GCM under the server's master key.

    Parameters
    ----------
    master_key : callable
        The server's key, 32 bytes; asked for at the first use.
    """

    def __init__(self, master_key: Callable[[], bytes]) -> None:
        self._master_key = master_key

    def seal(self, owner: str, secret: bytes) -> bytes:
        """A secret as it may be stored; `owner` names its owner and purpose, and is needed to decrypt it."""
        nonce = secrets.token_bytes(_NONCE_BYTES)
        return nonce + AESGCM(self._master_key()).encrypt(nonce, secret, owner.encode())

    def unseal(self, owner: str, sealed: bytes) -> bytes:
        """A secret that `seal` has sealed for the same owner.

        Raises
        ------
        Unavailable
            It was stored under another master key.
        """
        try:
            return AESGCM(self._master_key()).decrypt(sealed[:_NONCE_BYTES], sealed[_NONCE_BYTES:], owner.encode())
        except InvalidTag as error:
            raise Unavailable(
                "a stored key cannot be opened with this server's master key",
                cure="restore the master key that belongs to this database",
            ) from error

    def find_key(self, connection: sa.Connection, agency_id: str) -> bytes | None:
        """The agency's key, if it has one.

        Raises
        ------
        Unavailable
            It was stored under another master key.
        """
        wrapped = markers.find_secret(connection, agency_id)
        return None if wrapped is None else self.unseal(agency_id, wrapped)

    def ensure_key(self, connection: sa.Connection, agency_id: str, now: datetime) -> bytes:
        """The agency's key; made up in this transaction where it has none."""
        key = self.find_key(connection, agency_id)
        if key is None:
            key = secrets.token_bytes(AGENCY_KEY_BYTES)
            markers.add_secret(connection, agency_id, self.seal(agency_id, key), now)
        return key
