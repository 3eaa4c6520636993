"""The snapshot of an area: what vehicles without a connection know of its markers, signed by their server.

docs/snapshots.md has the format byte by byte, and decision 0020 why it is so. A server writes it
(`app.encoders.snapshot`), a vehicle reads it (`app.decoders.snapshot`); both know it from here.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Final

import numpy as np

from app.errors import InvalidParameter, UnreadableUpload

MAGIC: Final = b"WAYMARKS"
VERSION: Final = 3
"""Of the format. Files of other versions are refused."""
MAX_VALIDITY: Final = timedelta(days=7)
"""From creation to expiry, checked by the writer and by the reader. It limits how long somebody who withholds new
snapshots can keep a vehicle on an old one (freeze attack; The Update Framework 1.0, section 5.4.4). Decision 0020 chose
the length."""
MAX_KEYS: Final = 2
"""That a reader trusts at the same time: the one in use, and its predecessor or successor during a rotation."""
PUBLIC_KEY_BYTES: Final = 32
SIGNATURE_BYTES: Final = 64
MEDIA_TYPE: Final = "application/vnd.waymark.snapshot"
MAX_MARKERS: Final = 1_000_000

HEADER: Final = np.dtype(
    [
        ("magic", "S8"),
        ("version", "<u2"),
        ("reserved", "<u2"),
        ("markers", "<u4"),
        ("made_at_ms", "<i8"),
        ("expires_at_s", "<i8"),
        ("key_id", "V8"),
        ("agency_id", "V16"),
        ("west_deg", "<f8"),
        ("south_deg", "<f8"),
        ("east_deg", "<f8"),
        ("north_deg", "<f8"),
        ("kinds_bytes", "<u4"),
        ("codes_bytes", "<u4"),
        ("body_bytes", "<u4"),
        ("books_bytes", "<u4"),
    ]
)
"""First bytes of a file."""

COLUMNS: Final = (
    ("id", "V16"),
    ("lon_step", "<i8"),
    ("lat_step", "<i8"),
    ("height_mm", "<i4"),
    ("heading_step", "<u4"),
    ("horizontal_rmse_mm", "<u2"),
    ("vertical_rmse_mm", "<u2"),
    ("heading_rmse_step", "<u2"),
    ("kind", "<u2"),
    ("status", "u1"),
    ("flags", "u1"),
    ("code_bytes", "u1"),
    ("lane_lon_step", "<i8"),
    ("lane_lat_step", "<i8"),
    ("first_sequence", "<u4"),
    ("last_sequence", "<u4"),
    ("first_heard_ms", "<i8"),
    ("last_heard_ms", "<i8"),
)
"""Columns of the body, each whole before the next."""
ROW_BYTES: Final = sum(np.dtype(form).itemsize for _name, form in COLUMNS)
"""Of one marker in all columns. [bytes]"""

DEGREE_STEP: Final = 1e-9
"""Of longitude and latitude; 0.1 mm. [deg]"""
HEADING_STEP_DEG: Final = 1e-4
HEADING_RMSE_STEP_DEG: Final = 1e-3
NO_HEIGHT: Final = -(2**31)
NO_HEADING: Final = 2**32 - 1
NO_RMSE: Final = 2**16 - 1
NO_TIME: Final = -(2**63)
EXACT_FLAG: Final = 1
"""The position is fit for localization, by its survey's frame."""
ELLIPSOIDAL_FLAG: Final = 2
"""The height is above the ellipsoid."""
HEARD_FLAG: Final = 4
"""Transmissions of the CERPM were received before."""

RETIRED: Final = "retired"
"""Only CERPMs: what they say counts no more, whoever has their keys."""


class SnapshotRefused(UnreadableUpload):
    """A snapshot that must not be used."""


class NoSnapshot(SnapshotRefused):
    """It is another kind of file."""


class TruncatedSnapshot(SnapshotRefused):
    """Bytes are missing, or there are too many."""


class OldSnapshot(SnapshotRefused):
    """Its format is older than this reader's."""


class FutureSnapshot(SnapshotRefused):
    """Its format is newer than this reader's."""


class ForeignSnapshot(SnapshotRefused):
    """It was signed under a key that is not trusted, or is of another agency."""


class ForgedSnapshot(SnapshotRefused):
    """The signature does not fit: damaged, changed, or made by somebody else."""


class ExpiredSnapshot(SnapshotRefused):
    """Its time is over, has not begun, or is longer than a snapshot may be valid."""


class RolledBackSnapshot(SnapshotRefused):
    """It is older than one that this reader has already accepted."""


def key_id_of(public_key: bytes) -> bytes:
    """The eight bytes that name an Ed25519 public key: the first of its SHA-256."""
    return hashlib.sha256(public_key).digest()[:8]


@dataclass(frozen=True, slots=True)
class Trust:
    """What a reader verifies snapshots with. The operator installs it over a trusted channel.

    Raises
    ------
    InvalidParameter
        The agency is not a UUID, or the keys are none, more than two, equal or of another length.
    """

    agency_id: str  # UUID of the agency whose snapshots are accepted
    public_keys: tuple[bytes, ...]  # one or two Ed25519 public keys, 32 bytes each

    def __post_init__(self) -> None:
        """Check the values."""
        try:
            uuid.UUID(self.agency_id)
        except ValueError as error:
            raise InvalidParameter("the agency is not a UUID", field="agency_id", limit="a UUID") from error
        keys = self.public_keys
        if not 1 <= len(set(keys)) == len(keys) <= MAX_KEYS or {len(key) for key in keys} != {PUBLIC_KEY_BYTES}:
            raise InvalidParameter(
                "the public keys cannot be used",
                field="public_keys",
                limit=f"1 to {MAX_KEYS} different keys of {PUBLIC_KEY_BYTES} bytes",
            )

    @classmethod
    def from_document(cls, document: object) -> Trust:
        """Trust as `GET /v1/snapshots/trust` and `waymark snapshot trust` return it; other members are ignored.

        Raises
        ------
        InvalidParameter
            A member is missing, or its value cannot be used.
        """
        members = document if isinstance(document, Mapping) else {}
        agency_id, keys = members.get("agency_id"), members.get("public_keys")
        if not isinstance(agency_id, str) or not isinstance(keys, list) or not all(isinstance(k, str) for k in keys):
            raise InvalidParameter(
                "this is not a trust file",
                limit="an object with agency_id and public_keys",
                cure="fetch it from the server with GET /v1/snapshots/trust",
            )
        try:
            public_keys = tuple(bytes.fromhex(key) for key in keys)
        except ValueError as error:
            raise InvalidParameter(
                "a public key is not hexadecimal", field="public_keys", limit="64 digits each"
            ) from error
        return cls(agency_id, public_keys)

    def find_key(self, key_id: bytes) -> bytes | None:
        """The public key with this id."""
        return next((key for key in self.public_keys if key_id_of(key) == key_id), None)
