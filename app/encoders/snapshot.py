"""Markers of an area -> the snapshot that vehicles take along."""

from __future__ import annotations

import math
import uuid
import zlib
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import orjson
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.errors import InvalidParameter
from app.markers import snapshot as layout
from app.markers.status import STATUSES

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_HEIGHT_LIMIT_MM = 2**31 - 1


def write_snapshot(
    markers: Sequence[Mapping[str, Any]],
    *,
    agency_id: str,
    area_deg: tuple[float, float, float, float],
    made_at: datetime,
    expires_at: datetime,
    key: Ed25519PrivateKey,
    codebooks: Sequence[Mapping[str, Any]] = (),
) -> bytes:
    """A signed snapshot.

    Parameters
    ----------
    markers : sequence of mapping
        id, family, status, code, kind (what markers have in common, a mapping), lon_deg, lat_deg, height_m,
        vertical_datum, heading_deg, horizontal_rmse_m, vertical_rmse_m, heading_rmse_deg, localization_grade; of
        information tags lane_lon_deg and lane_lat_deg, where their lane begins; of CERPMs that were heard before
        first_sequence, last_sequence, and first_heard_s, last_heard_s (None where that is not known).
    agency_id : str
    area_deg : tuple of float
        west, south, east, north.
    made_at, expires_at : datetime
        Aware; kept to the millisecond and to the second. Readers refuse a snapshot that was made before one that they
        have already accepted.
    key : Ed25519PrivateKey
    codebooks : sequence of mapping
        As `Codebook.to_document` writes them.

    Raises
    ------
    InvalidParameter
        There are too many markers, too many kinds of them, or the snapshot would be valid for more than
        `app.markers.snapshot.MAX_VALIDITY`.
    """
    if expires_at - made_at > layout.MAX_VALIDITY:
        raise InvalidParameter(
            "the snapshot would be valid for too long", field="expires_at", limit=f"{layout.MAX_VALIDITY.days} days"
        )
    if len(markers) > layout.MAX_MARKERS:
        raise InvalidParameter(
            f"the area has more than {layout.MAX_MARKERS} markers",
            field="bbox",
            limit=f"{layout.MAX_MARKERS} markers",
            cure="ask for a smaller area",
        )
    kinds: dict[bytes, int] = {}
    numbers = [kinds.setdefault(_kind(marker), len(kinds)) for marker in markers]
    if len(kinds) > 2**16:
        raise InvalidParameter(
            "the markers differ in too much", field="bbox", limit="65536 kinds", cure="ask for a smaller area"
        )
    codes = [str(marker["code"] or "").encode()[:255] for marker in markers]
    body = zlib.compress(
        b"".join(column.tobytes() for column in _columns(markers, numbers, codes))
        + (kinds_text := b"[" + b",".join(kinds) + b"]")
        + (codes_text := b"".join(codes))
        + (books_text := orjson.dumps(list(codebooks))),
        level=6,
    )
    header = np.zeros((), dtype=layout.HEADER)
    header["magic"], header["version"], header["markers"] = layout.MAGIC, layout.VERSION, len(markers)
    header["made_at_ms"] = (made_at - _EPOCH) // timedelta(milliseconds=1)
    header["expires_at_s"] = (expires_at - _EPOCH) // timedelta(seconds=1)
    header["key_id"] = np.void(layout.key_id_of(key.public_key().public_bytes_raw()))
    header["agency_id"] = np.void(uuid.UUID(agency_id).bytes)
    for name, value in zip(("west_deg", "south_deg", "east_deg", "north_deg"), area_deg, strict=True):
        header[name] = value
    header["kinds_bytes"], header["codes_bytes"], header["body_bytes"] = len(kinds_text), len(codes_text), len(body)
    header["books_bytes"] = len(books_text)
    signed = header.tobytes() + body
    return signed + key.sign(signed)


def _kind(marker: Mapping[str, Any]) -> bytes:
    return orjson.dumps({"family": marker["family"], **marker["kind"]}, option=orjson.OPT_SORT_KEYS)


def _columns(
    markers: Sequence[Mapping[str, Any]], kinds: Sequence[int], codes: Sequence[bytes]
) -> list[np.ndarray[Any, Any]]:
    values = {
        "id": [uuid.UUID(marker["id"]).bytes for marker in markers],
        "lon_step": [round(marker["lon_deg"] / layout.DEGREE_STEP) for marker in markers],
        "lat_step": [round(marker["lat_deg"] / layout.DEGREE_STEP) for marker in markers],
        "height_mm": [_height_mm(marker["height_m"]) for marker in markers],
        "heading_step": [_heading(marker["heading_deg"]) for marker in markers],
        "horizontal_rmse_mm": [_rmse(marker["horizontal_rmse_m"], 1e-3) for marker in markers],
        "vertical_rmse_mm": [_rmse(marker["vertical_rmse_m"], 1e-3) for marker in markers],
        "heading_rmse_step": [_rmse(marker["heading_rmse_deg"], layout.HEADING_RMSE_STEP_DEG) for marker in markers],
        "kind": kinds,
        "status": [STATUSES.index(marker["status"]) for marker in markers],
        "flags": [_flags(marker) for marker in markers],
        "code_bytes": [len(code) for code in codes],
        "lane_lon_step": [round((marker.get("lane_lon_deg") or 0.0) / layout.DEGREE_STEP) for marker in markers],
        "lane_lat_step": [round((marker.get("lane_lat_deg") or 0.0) / layout.DEGREE_STEP) for marker in markers],
        "first_sequence": [marker.get("first_sequence") or 0 for marker in markers],
        "last_sequence": [marker.get("last_sequence") or 0 for marker in markers],
        "first_heard_ms": [_heard_ms(marker.get("first_heard_s")) for marker in markers],
        "last_heard_ms": [_heard_ms(marker.get("last_heard_s")) for marker in markers],
    }
    return [np.array(values[name], dtype=form) for name, form in layout.COLUMNS]


def _height_mm(height_m: float | None) -> int:
    if height_m is None or abs(height_m) * 1000 > _HEIGHT_LIMIT_MM:
        return layout.NO_HEIGHT
    return round(height_m * 1000)


def _heading(heading_deg: float | None) -> int:
    return layout.NO_HEADING if heading_deg is None else round(heading_deg / layout.HEADING_STEP_DEG) % 3_600_000


def _rmse(value: float | None, step: float) -> int:
    """Steps, rounded up: an accuracy is never shown better than it is."""
    return layout.NO_RMSE if value is None else min(math.ceil(value / step - 1e-6), layout.NO_RMSE - 1)


def _heard_ms(time_s: float | None) -> int:
    return layout.NO_TIME if time_s is None or not math.isfinite(time_s) else round(time_s * 1000)


def _flags(marker: Mapping[str, Any]) -> int:
    flags = layout.EXACT_FLAG if marker["localization_grade"] != "unfit" else 0
    flags |= layout.ELLIPSOIDAL_FLAG if marker["vertical_datum"] in (None, "ellipsoid") else 0
    return flags | (layout.HEARD_FLAG if marker.get("last_sequence") is not None else 0)
