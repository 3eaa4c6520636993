"""CERPMs as clients see them."""

from __future__ import annotations

from typing import Literal

from typing_extensions import TypedDict

from app.families.documents import MarkerDocument, marker_head, marker_place
from app.registry.marker_rows import MarkerRow


class CerpmCodeDocument(TypedDict):
    """What identifies a CERPM within its agency."""

    scheme: Literal["cerpm"]
    text: str
    number: int


class SpeedLimitDocument(TypedDict):
    """A posted speed limit."""

    value: int
    unit: Literal["km/h", "mph"]


class RadioDocument(TypedDict):
    """Settings of a CERPM's radio."""

    frequency_hz: int
    spreading_factor: int
    bandwidth_hz: int
    interval_s: float
    jitter_share: float
    power_dbm: float
    antenna_gain_dbi: float
    channels: int
    hopping: bool
    coding_rate: int
    preamble_symbols: int
    explicit_header: bool
    crc: bool
    lorawan: bool


class CerpmSpec(TypedDict):
    """What the row of a CERPM has in its column `spec`."""

    side: Literal["left", "right", "unknown"]
    speed_limit: SpeedLimitDocument | None
    dev_eui: str | None
    radio: RadioDocument


class CerpmDocument(MarkerDocument, CerpmSpec):
    """A CERPM."""

    code: CerpmCodeDocument


def cerpm_document(row: MarkerRow) -> CerpmDocument:
    """A CERPM's row as clients see it."""
    spec: CerpmSpec = row.spec
    return {
        **marker_head(row),
        "code": {"scheme": "cerpm", "text": row.digits, "number": int(row.digits)},
        "side": spec["side"],
        "speed_limit": spec["speed_limit"],
        "dev_eui": spec["dev_eui"],
        "radio": spec["radio"],
        **marker_place(row),
    }
