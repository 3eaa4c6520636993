"""Packets as a receiver in a vehicle received them."""

from __future__ import annotations

from dataclasses import dataclass

from app.markers.cerpm import LaneSide, SpeedLimit


@dataclass(frozen=True, slots=True)
class PlainClaim:
    """Contents of a packet in clear, as in the CERPM paper, without a tag: anyone could have sent it."""

    number: int
    lon_deg: float
    lat_deg: float
    height_m: float | None = None
    side: LaneSide = LaneSide.UNKNOWN
    speed_limit: SpeedLimit | None = None


@dataclass(frozen=True, slots=True)
class ReceivedPacket:
    """One packet as logged by a receiver or a network server.

    Attributes
    ----------
    entry : int
        Which row, line or event of the log it came from, from 0.
    received_at_s : float
        Time of reception, seconds since 1970-01-01 UTC; NaN if the log has none. [s]
    payload : bytes or None
        The message as it was sent, with its tag; None for a packet in clear.
    claim : PlainClaim or None
        Contents of a packet in clear; None where there is a payload.
    rssi_dbm, snr_db : float
        NaN if the log has none.
    device : str or None
        LoRaWAN DevEUI or another name of the sender in the log.
    event : str or None
        Identifier of the uplink on its network server; packets with the same one are one uplink received twice.
    """

    entry: int
    received_at_s: float
    payload: bytes | None = None
    claim: PlainClaim | None = None
    rssi_dbm: float = float("nan")
    snr_db: float = float("nan")
    device: str | None = None
    event: str | None = None
