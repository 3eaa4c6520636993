"""The snapshot of an area: what vehicles without a connection know of its markers, signed by their server.

docs/snapshots.md has the format byte by byte, and decision 0012 why it is so. A server writes it
(`app.encoders.snapshot`), a vehicle reads it (`app.decoders.snapshot`); both know it from here.
"""

from __future__ import annotations

import hashlib
from typing import Final

import numpy as np

from app.errors import UnreadableUpload

MAGIC: Final = b"WAYMARKS"
VERSION: Final = 2
"""That is written; older ones are read too."""
SIGNATURE_BYTES: Final = 64
MEDIA_TYPE: Final = "application/vnd.waymark.snapshot"
MAX_MARKERS: Final = 1_000_000

_FIELDS = [
    ("magic", "S8"),
    ("version", "<u2"),
    ("reserved", "<u2"),
    ("markers", "<u4"),
    ("made_at_s", "<i8"),
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
]

HEADERS: Final = {1: np.dtype(_FIELDS), 2: np.dtype([*_FIELDS, ("books_bytes", "<u4")])}
"""First bytes of a file, by its version."""
HEADER = HEADERS[VERSION]

_COLUMNS = (
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
)
_COLUMNS_OF_TAGS_AND_CERPMS = (
    ("lane_lon_step", "<i8"),
    ("lane_lat_step", "<i8"),
    ("first_sequence", "<u4"),
    ("last_sequence", "<u4"),
    ("first_heard_ms", "<i8"),
    ("last_heard_ms", "<i8"),
)
COLUMNS: Final = {1: _COLUMNS, 2: (*_COLUMNS, *_COLUMNS_OF_TAGS_AND_CERPMS)}
"""Columns of the body by the file's version, each whole before the next."""


def row_bytes(version: int) -> int:
    """Of one marker in all columns. [bytes]"""
    return sum(np.dtype(form).itemsize for _name, form in COLUMNS[version])


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
"""Transmissions of the CERPM were heard before."""

RETIRED: Final = "retired"
"""Only CERPMs: what they say counts no more, whoever has their keys."""


class SnapshotRefused(UnreadableUpload):
    """A snapshot that must not be used."""


class NoSnapshot(SnapshotRefused):
    """It is another kind of file."""


class TruncatedSnapshot(SnapshotRefused):
    """Bytes are missing, or there are too many."""


class FutureSnapshot(SnapshotRefused):
    """It is of a version that this reader does not know."""


class ForeignSnapshot(SnapshotRefused):
    """It was signed under another key than the one it is to be verified with."""


class ForgedSnapshot(SnapshotRefused):
    """The signature does not fit: damaged, changed, or made by somebody else."""


class ExpiredSnapshot(SnapshotRefused):
    """Its time is over, or has not begun."""


def key_id_of(public_key: bytes) -> bytes:
    """The eight bytes that name an Ed25519 public key: the first of its SHA-256."""
    return hashlib.sha256(public_key).digest()[:8]
