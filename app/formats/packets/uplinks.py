"""Packets from uplink events of LoRaWAN network servers: ChirpStack v4 and The Things Stack v3.

Both write proto3 JSON: what is zero, false or empty is left out. Sources: ChirpStack's api/proto/integration and
api/proto/gw (v4); The Things Stack's "Data Formats" and "Storage Integration" pages (v3).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from enum import StrEnum
from typing import Any

from app.formats.log_times import LogClock, TimeScale, utc_from_gps_s
from app.formats.packets.rows import BrokenEntry, PayloadText, read_payload
from app.formats.text import clean_text
from app.sensors.receiver import ReceivedPacket

_LEVELS = 5  # envelopes around an event; chosen by hand
_ENVELOPES = ("payload", "result", "data", "message", "msg", "body", "event")
_DURATION = re.compile(r"(\d{1,12}(?:\.\d{1,9})?)s\Z", re.ASCII)
_OTHER_EVENTS = (
    "join_accept", "downlink_ack", "downlink_nack", "downlink_sent", "downlink_failed", "downlink_queued",
    "downlink_queue_invalidated", "location_solved", "service_data", "uplink_normalized",
)  # fmt: skip


class UplinkKind(StrEnum):
    """The network server that an event is from."""

    CHIRPSTACK = "chirpstack-v4"
    THINGS_STACK = "things-stack-v3"


def open_envelope(record: Mapping[str, Any]) -> tuple[Mapping[str, Any], str | None]:
    """The event inside the envelopes of brokers, dumps and storage, and the time of the outermost envelope.

    `{"topic": ..., "payload": {...} or its text}` of MQTT dumps, `{"result": {...}}` of The Things Stack's storage,
    `{"name": "as.up.data.forward", "data": {...}}` of its event streams.

    Raises
    ------
    BrokenEntry
        The text inside is no JSON, or the entry is an error message.
    """
    outer_time: str | None = None
    for _level in range(_LEVELS):
        if find_kind(record) is not None:
            break
        inner = next((record[name] for name in _ENVELOPES if _is_event(record.get(name))), None)
        if inner is None:
            break
        outer_time = outer_time or next(
            (str(record[n]) for n in ("received_at", "time", "timestamp", "tst") if record.get(n)), None
        )
        if isinstance(inner, str):
            try:
                inner = json.loads(inner)
            except (ValueError, RecursionError):
                raise BrokenEntry("json", "the text in the envelope is not JSON") from None
            if not isinstance(inner, dict):
                raise BrokenEntry("json", "the text in the envelope is no JSON object")
        record = inner
    if isinstance(record.get("error"), dict):
        raise BrokenEntry("error", f"an error in place of an event: {clean_text(record['error'].get('message'))}")
    return record, outer_time


def _is_event(value: object) -> bool:
    return isinstance(value, dict) or (isinstance(value, str) and value.lstrip()[:1] == "{")


def find_kind(record: Mapping[str, Any]) -> UplinkKind | None:
    """The network server that a JSON object is from; None if it is no uplink event."""
    if "end_device_ids" in record:
        return UplinkKind.THINGS_STACK
    if (
        "deduplicationId" in record
        or isinstance(record.get("deviceInfo"), dict)
        or isinstance(record.get("rxInfo"), list)
    ):
        return UplinkKind.CHIRPSTACK
    if "devEUI" in record and "applicationID" in record:
        return UplinkKind.CHIRPSTACK
    return None


def packet_from_uplink(entry: int, kind: UplinkKind, record: Mapping[str, Any], clock: LogClock) -> ReceivedPacket:
    """One packet of an uplink event.

    Raises
    ------
    BrokenEntry
        It is another kind of event, or has no payload that can be read.
    """
    if kind is UplinkKind.CHIRPSTACK:
        return _from_chirpstack(entry, record, clock)
    return _from_things_stack(entry, record, clock)


# --- ChirpStack v4 ------------------------------------------------------------------------------------------------


def _from_chirpstack(entry: int, record: Mapping[str, Any], clock: LogClock) -> ReceivedPacket:
    if "devEUI" in record and "deviceInfo" not in record:
        raise BrokenEntry("old-version", "an event of ChirpStack v3 or older; v4 is read")
    receptions = _objects(record.get("rxInfo"))
    if not receptions and not record.get("data"):
        raise BrokenEntry("not-uplink", "a ChirpStack event that is no uplink")
    if record.get("joinServerContext"):
        raise BrokenEntry(
            "encrypted", "the payload is still encrypted: ChirpStack has no session key (joinServerContext)"
        )
    payload = read_payload(record.get("data"), PayloadText.BASE64)
    if payload is None:
        raise BrokenEntry("no-payload", "an uplink without a payload")
    best = _best(receptions)
    device = record.get("deviceInfo")
    times = (record.get("time"), best.get("gwTime"), best.get("nsTime"))
    received_at_s = _first_time(times, clock)
    if math.isnan(received_at_s):
        received_at_s = _gps_time(best.get("timeSinceGpsEpoch"), clock)
    return ReceivedPacket(
        entry,
        received_at_s,
        payload,
        rssi_dbm=_signal(best.get("rssi"), math.nan),
        snr_db=_signal(best.get("snr"), 0.0 if best else math.nan),  # 0 is left out
        device=clean_text(device.get("devEui")) if isinstance(device, dict) else None,
        event=clean_text(record.get("deduplicationId")),
    )


def _gps_time(value: object, clock: LogClock) -> float:
    found = _DURATION.match(value) if isinstance(value, str) else None
    return LogClock(TimeScale.UNIX_S, clock.offset_s).read(utc_from_gps_s(float(found[1]))) if found else math.nan


# --- The Things Stack v3 ------------------------------------------------------------------------------------------


def _from_things_stack(entry: int, record: Mapping[str, Any], clock: LogClock) -> ReceivedPacket:
    uplink = record.get("uplink_message")
    if not isinstance(uplink, dict):
        other = next((name for name in _OTHER_EVENTS if name in record), "of no known kind")
        raise BrokenEntry("not-uplink", f"an event of The Things Stack that is no uplink: {other}")
    if record.get("simulated"):
        raise BrokenEntry("simulated", "a simulated uplink: nothing was received")
    payload = read_payload(uplink.get("frm_payload"), PayloadText.BASE64)
    if payload is None:
        raise BrokenEntry("no-payload", "an uplink without a payload")
    best = _best(_objects(uplink.get("rx_metadata")))
    settings = uplink.get("settings")
    times = (
        uplink.get("received_at"),
        record.get("received_at"),
        best.get("time"),
        settings.get("time") if isinstance(settings, dict) else None,
    )
    ids = record["end_device_ids"] if isinstance(record["end_device_ids"], dict) else {}
    eui = clean_text(ids.get("dev_eui"))
    session = clean_text(uplink.get("session_key_id"))
    count = uplink.get("f_cnt", 0)
    return ReceivedPacket(
        entry,
        _first_time(times, clock),
        payload,
        rssi_dbm=_signal(best.get("rssi"), _signal(best.get("channel_rssi"), math.nan)),
        snr_db=_signal(best.get("snr"), 0.0 if best else math.nan),
        device=eui or clean_text(ids.get("device_id")),
        event=f"{eui}/{session}/{clean_text(count)}" if eui and session else None,
    )


# --- both ---------------------------------------------------------------------------------------------------------


def _objects(value: object) -> list[dict[str, Any]]:
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def _best(receptions: list[dict[str, Any]]) -> dict[str, Any]:
    """The reception of the strongest gateway; an RSSI of zero, which is left out, was not measured."""
    return max(receptions, key=lambda reception: _signal(reception.get("rssi"), -math.inf), default={})


def _first_time(values: tuple[object, ...], clock: LogClock) -> float:
    for value in values:
        if isinstance(value, str):
            at = clock.read(value)
            if not math.isnan(at):
                return at
    return math.nan


def _signal(value: object, missing: float) -> float:
    """An RSSI or SNR; those that no receiver measures are missing."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not -200 <= value <= 60:
        return missing
    return float(value)
