"""Packets as a receiver in a vehicle heard them."""

from __future__ import annotations

from dataclasses import dataclass

from app.markers.cerpm import LaneSide, SpeedLimit


@dataclass(frozen=True, slots=True)
class PlainClaim:
    """What a packet of the paper's kind says in clear, without a tag: anyone could have sent it."""

    number: int
    lon_deg: float
    lat_deg: float
    height_m: float | None = None
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit: SpeedLimit | None = None


@dataclass(frozen=True, slots=True)
class HeardPacket:
    """One packet as a receiver or a network server gave it.

    Attributes
    ----------
    entry : int
        Which row, line or event of the log it came from, from 0.
    heard_at_s : float
        When it was heard, seconds since 1970-01-01 UTC; NaN where the log does not say. [s]
    payload : bytes or None
        The message as it was sent, tag and all; None for a packet in clear.
    claim : PlainClaim or None
        What a packet in clear says; None where there is a payload.
    rssi_dbm, snr_db : float
        NaN where the log does not say.
    device : str or None
        LoRaWAN DevEUI or another name of the sender that the receiver gave.
    event : str or None
        What makes the uplink unique on its network server; packets with the same are the same one heard twice.
    """

    entry: int
    heard_at_s: float
    payload: bytes | None = None
    claim: PlainClaim | None = None
    rssi_dbm: float = float("nan")
    snr_db: float = float("nan")
    device: str | None = None
    event: str | None = None
