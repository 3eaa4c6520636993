"""Markers of an area -> the snapshot that vehicles take along."""

from __future__ import annotations

import uuid
import zlib
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import numpy.typing as npt
import orjson
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.errors import InvalidParameter
from app.markers import snapshot as layout
from app.markers.reading import STATUSES

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_HEIGHT_LIMIT_MM = 2**31 - 1
_STATUS_NUMBERS = {status: number for number, status in enumerate(STATUSES)}
_OPTIONAL = ("lane_lon_deg", "lane_lat_deg", "first_sequence", "last_sequence", "first_heard_s", "last_heard_s")
Block = Mapping[str, Sequence[object] | npt.NDArray[Any]]
"""Markers by columns: sequences of one length, by the names of `write_snapshot`."""


def write_snapshot(
    blocks: Iterable[Block],
    *,
    agency_id: str,
    area_deg: tuple[float, float, float, float],
    made_at: datetime,
    expires_at: datetime,
    key: Ed25519PrivateKey,
    codebooks: Sequence[Mapping[str, object]] = (),
) -> bytes:
    """A signed snapshot.

    Parameters
    ----------
    blocks : iterable of mapping
        Markers in any order, some thousands at a time, each block by columns; a missing value is None or NaN. id,
        status, code, kind (`kind_text`), lon_deg, lat_deg, height_m, vertical_datum, heading_deg, horizontal_rmse_m,
        vertical_rmse_m, heading_rmse_deg, localization_grade; of information tags lane_lon_deg and lane_lat_deg, where
        their lane begins; of CERPMs that were received before first_sequence, last_sequence, and first_heard_s,
        last_heard_s.
    area_deg : tuple of float
        west, south, east, north.
    made_at, expires_at : datetime
        Aware; kept to the millisecond and to the second. Readers refuse a snapshot that was made before one that they
        have already accepted.
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
    kinds: dict[bytes, int] = {}
    parts: list[dict[str, npt.NDArray[Any]]] = []
    codes: list[bytes] = []
    for block in blocks:
        codes += [str(code or "").encode()[:255] for code in block["code"]]
        if len(codes) > layout.MAX_MARKERS:
            raise too_many_markers()
        parts.append(_encoded(block, kinds, codes[-len(block["code"]) :]))
        if len(kinds) > 2**16:
            raise InvalidParameter(
                "the markers differ in too much", field="bbox", limit="65536 kinds", cure="ask for a smaller area"
            )
    count = len(codes)
    packed = zlib.compressobj(level=6)
    body = bytearray()
    order = _order([part["id"] for part in parts])
    for name, form in layout.COLUMNS:
        column = np.concatenate([np.empty(0, dtype=form), *(part.pop(name) for part in parts)])
        body += packed.compress(column[order].tobytes())
    kinds_text = b"[" + b",".join(kinds) + b"]"
    codes_text = b"".join([codes[k] for k in order.tolist()])
    books_text = orjson.dumps(list(codebooks))
    for text in (kinds_text, codes_text, books_text):
        body += packed.compress(text)
    body += packed.flush()
    header = np.zeros((), dtype=layout.HEADER)
    header["magic"], header["version"], header["markers"] = layout.MAGIC, layout.VERSION, count
    header["made_at_ms"] = (made_at - _EPOCH) // timedelta(milliseconds=1)
    header["expires_at_s"] = (expires_at - _EPOCH) // timedelta(seconds=1)
    header["key_id"] = np.void(layout.key_id_of(key.public_key().public_bytes_raw()))
    header["agency_id"] = np.void(uuid.UUID(agency_id).bytes)
    for name, value in zip(("west_deg", "south_deg", "east_deg", "north_deg"), area_deg, strict=True):
        header[name] = value
    header["kinds_bytes"], header["codes_bytes"], header["body_bytes"] = len(kinds_text), len(codes_text), len(body)
    header["books_bytes"] = len(books_text)
    signed = header.tobytes() + bytes(body)
    return signed + key.sign(signed)


def kind_text(family: str, kind: Mapping[str, object]) -> bytes:
    """What markers of a family have in common, as it is in snapshots; the kind of many markers is made once."""
    return orjson.dumps({"family": family, **kind}, option=orjson.OPT_SORT_KEYS)


def too_many_markers() -> InvalidParameter:
    """The refusal of an area with more markers than a snapshot has."""
    return InvalidParameter(
        f"the area has more than {layout.MAX_MARKERS} markers",
        field="bbox",
        limit=f"{layout.MAX_MARKERS} markers",
        cure="ask for a smaller area",
    )


def _order(ids: Sequence[npt.NDArray[Any]]) -> npt.NDArray[np.intp]:
    """Markers in the order of their ids."""
    halves = np.frombuffer(b"".join(part.tobytes() for part in ids), dtype=">u8").reshape(-1, 2)
    return np.lexsort((halves[:, 1], halves[:, 0]))


def _encoded(block: Block, kinds: dict[bytes, int], codes: Sequence[bytes]) -> dict[str, npt.NDArray[Any]]:
    """The columns of a block in the forms of `layout.COLUMNS`; kinds that are new get the next numbers."""
    count = len(codes)
    of: dict[str, Sequence[Any] | npt.NDArray[Any]] = {**dict.fromkeys(_OPTIONAL, (None,) * count), **block}
    ids = bytes.fromhex("".join(map(str, of["id"])).replace("-", ""))
    exact = np.array(of["localization_grade"]) != "unfit"
    ellipsoidal = np.fromiter((datum in (None, "ellipsoid") for datum in of["vertical_datum"]), bool, count)
    first, last = (_floats(of[name]) for name in ("first_sequence", "last_sequence"))
    flags = layout.EXACT_FLAG * exact + layout.ELLIPSOIDAL_FLAG * ellipsoidal + layout.HEARD_FLAG * np.isfinite(last)
    values = {
        "id": np.frombuffer(ids, dtype="V16"),
        "lon_step": _steps(of["lon_deg"], layout.DEGREE_STEP),
        "lat_step": _steps(of["lat_deg"], layout.DEGREE_STEP),
        "height_mm": _heights_mm(_floats(of["height_m"])),
        "heading_step": _headings(_floats(of["heading_deg"])),
        "horizontal_rmse_mm": _rmse(of["horizontal_rmse_m"], 1e-3),
        "vertical_rmse_mm": _rmse(of["vertical_rmse_m"], 1e-3),
        "heading_rmse_step": _rmse(of["heading_rmse_deg"], layout.HEADING_RMSE_STEP_DEG),
        "kind": np.array([kinds.setdefault(kind, len(kinds)) for kind in of["kind"]]),
        "status": np.array([_STATUS_NUMBERS[status] for status in of["status"]]),
        "flags": flags,
        "code_bytes": np.array(list(map(len, codes))),
        "lane_lon_step": _steps(of["lane_lon_deg"], layout.DEGREE_STEP),
        "lane_lat_step": _steps(of["lane_lat_deg"], layout.DEGREE_STEP),
        "first_sequence": np.nan_to_num(first),
        "last_sequence": np.nan_to_num(last),
        "first_heard_ms": _heard_ms(_floats(of["first_heard_s"])),
        "last_heard_ms": _heard_ms(_floats(of["last_heard_s"])),
    }
    return {name: np.asarray(values[name]).astype(form) for name, form in layout.COLUMNS}


def _floats(values: Sequence[object] | npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Numbers, NaN where there is none."""
    return np.asarray(values, dtype=np.float64)


def _steps(values: Sequence[object] | npt.NDArray[Any], step: float) -> npt.NDArray[np.int64]:
    """Whole steps, rounded to the even one; 0 where there is no value."""
    return np.rint(np.nan_to_num(_floats(values)) / step).astype(np.int64)


def _heights_mm(height_m: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    known = np.abs(height_m) * 1000 <= _HEIGHT_LIMIT_MM
    return np.where(known, _steps(np.where(known, height_m * 1000, 0.0), 1.0), layout.NO_HEIGHT)


def _headings(heading_deg: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    steps = _steps(heading_deg, layout.HEADING_STEP_DEG) % 3_600_000
    return np.where(np.isfinite(heading_deg), steps, layout.NO_HEADING)


def _rmse(values: Sequence[object] | npt.NDArray[Any], step: float) -> npt.NDArray[np.int64]:
    """Steps, rounded up: an accuracy is never shown better than it is."""
    rmse = _floats(values)
    steps = np.minimum(np.ceil(np.nan_to_num(rmse) / step - 1e-6), layout.NO_RMSE - 1)
    return np.where(np.isfinite(rmse), steps, layout.NO_RMSE).astype(np.int64)


def _heard_ms(time_s: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    known = np.isfinite(time_s)
    return np.where(known, _steps(np.where(known, time_s * 1000, 0.0), 1.0), layout.NO_TIME)
