"""Packet logs of all formats, whole and broken."""

from __future__ import annotations

import base64
import json
import math
from datetime import UTC, datetime
from time import process_time
from typing import Any

import pytest
from pydantic import ValidationError

from app.errors import InvalidParameter, UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.logs import LogClock, TimeScale, utc_from_gps_s
from app.formats.packets.json import UplinkKind
from app.formats.packets.read import PacketLog, read_packets
from app.formats.packets.rows import PacketDeclaration, PacketFormat, PacketLimits, PayloadText
from app.markers.cerpm import LaneSide, SpeedLimit, SpeedUnit
from app.sensors.pose_track import PlainClaim
from tests.decoders.cerpm.events import STORED, chirpstack, things_stack
from tests.decoders.cerpm.payloads import LAT_DEG, LON_DEG, body, signed

PAYLOAD = signed(body(sequence=9))
PAPER = (
    "id,latitude,longitude,altitude,rssi,snr,timestamp\n"
    "7,42.2834567,-85.6123456,251.2,-108,6.5,2026-03-16T13:39:32Z\n"
    "8,42.2835,-85.6124,,-125,-11.25,2026-03-16T13:39:33.5Z\n"
)
AT_S = datetime(2026, 3, 16, 13, 39, 32, tzinfo=UTC).timestamp()


def read(content: str | bytes, declaration: PacketDeclaration | None = None, **limits: int) -> PacketLog:
    """A log without a telling name."""
    data = content.encode() if isinstance(content, str) else content
    return read_packets("upload", data, declaration, PacketLimits(**limits))


def payloads(log: PacketLog) -> list[bytes | None]:
    """Of each packet."""
    return [packet.payload for packet in log.packets]


# --- rows ---------------------------------------------------------------------------------------------------------


def test_the_papers_columns() -> None:
    log = read(PAPER)
    first, second = log.packets
    assert log.report.format == PacketFormat.CSV
    assert first.claim == PlainClaim(7, LON_DEG, LAT_DEG, 251.2)
    assert (first.received_at_s, first.rssi_dbm, first.snr_db) == (AT_S, -108.0, 6.5)
    assert second.claim is not None
    assert second.claim.height_m is None
    assert second.received_at_s == AT_S + 1.5


@pytest.mark.parametrize(
    "text",
    [
        PAPER.replace(",", ";"),
        PAPER.replace(",", "\t").replace("\n", "\r\n"),
        PAPER.replace(",", ";").replace(".", ",").replace("33,5Z", "33.5Z"),
        PAPER.replace("id,latitude,longitude", "Marker ID,Latitude [deg],lng"),
        "\ufeff" + PAPER,
        PAPER + "\n\n",
        "# " + PAPER,
        '"id","latitude","longitude","altitude","rssi","snr","timestamp"\n7,"42.2834567",-85.6123456,251.2,-108,6.5,"'
        '2026-03-16T13:39:32Z"\n8,42.2835,-85.6124,,-125,-11.25,2026-03-16T13:39:33.5Z\n',
    ],
)
def test_ways_to_write_a_table(text: str) -> None:
    assert read(text).packets == read(PAPER).packets


def test_cells_at_the_ends_of_rows_may_be_empty_between_tabs() -> None:
    text = "altitude\tid\tlatitude\tlongitude\trssi\n\t7\t42\t-85\t-108\n1.5\t8\t42\t-85\t\n\t9\t42\t-85\t\n"
    for written in (text, text.replace("\t\n", "\t\t\n"), text.replace("rssi\n", "rssi\t\n")):
        packets = read(written).packets
        assert [packet.claim.number for packet in packets if packet.claim] == [7, 8, 9]
        assert [packet.claim.height_m for packet in packets if packet.claim] == [None, 1.5, None]
        assert packets[0].rssi_dbm == -108
        assert math.isnan(packets[2].rssi_dbm)


def test_utf_16_is_read() -> None:
    assert read(PAPER.encode("utf-16")).packets == read(PAPER).packets


def test_speed_limits_and_sides_of_claims() -> None:
    log = read("id,lat,lon,side,speed_limit_mph\n1,42,-85,left,35\n2,42,-85,R,\n3,42,-85,?,0\n")
    claims = [packet.claim for packet in log.packets if packet.claim]
    assert [claim.side for claim in claims] == [LaneSide.LEFT, LaneSide.RIGHT, LaneSide.UNKNOWN]
    assert [claim.speed_limit for claim in claims] == [SpeedLimit(35, SpeedUnit.MPH), None, None]


@pytest.mark.parametrize(
    "written",
    [
        PAYLOAD.hex(),
        "0x" + PAYLOAD.hex().upper(),
        PAYLOAD.hex(" "),
        PAYLOAD.hex(":"),
        base64.b64encode(PAYLOAD).decode(),
    ],
)
def test_payloads_in_columns(written: str) -> None:
    log = read(f"time,payload,rssi\n{AT_S},{written},-110\n")
    assert payloads(log) == [PAYLOAD]
    assert log.packets[0].received_at_s == AT_S
    assert payloads(read(json.dumps({"payload": written, "rssi": -110}))) == [PAYLOAD]


def test_text_that_is_hex_and_base64_is_read_as_declared() -> None:
    both = "10" * 16  # 16 bytes in hex, 24 in base64
    assert len(payloads(read(f"payload,rssi\n{both},-1\n"))[0] or b"") == 24
    declared = PacketDeclaration(payload_text=PayloadText.HEX)
    assert payloads(read(f"payload,rssi\n{both},-1\n", declared)) == [b"\x10" * 16]
    assert payloads(read(f"payload_hex,rssi\n{both},-1\n")) == [b"\x10" * 16]


def test_broken_rows_are_counted_and_left_out() -> None:
    rows = [
        "7,42.28,-85.61,,-108,6,2026-03-16T13:39:32Z",
        "7,42.28,-85.61",
        "seven,42.28,-85.61,,-108,6,",
        "7,99,-85.61,,-108,6,",
        "7,nan,-85.61,,-108,6,",
        "7,42.28,1e999,,-108,6,",
        "7,42.28,-85.61,,loud,6,",
        "999999999999999999999999,42.28,-85.61,,-108,6,",
        '7,"42.28,-85.61,,-108,6,',
        "7,42.28,-85.61,,-108,6,\0",
        "7,42.28,-85.61,,-108,6," + "x" * 300_000,
        "0,42.28,-85.61,,-108,6,",
        "7,42.28,-85.61,,-108,6,2026-03-16T13:39:40Z",
    ]
    log = read("id,latitude,longitude,altitude,rssi,snr,timestamp\n" + "\n".join(rows))
    assert [packet.entry for packet in log.packets] == [0, 9, 12]
    assert math.isnan(log.packets[1].received_at_s)
    assert log.report.entries == 13
    assert log.report.left_out_count == 10
    assert [left.entry for left in log.report.left_out] == [1, 2, 3, 4, 5, 6, 7, 8, 10, 11]
    assert "lat_deg is 99" in log.report.left_out[2].reason


def test_positions_of_another_datum_are_left_out_by_name() -> None:
    log = read("id,lat,lon,crs\n1,42,-85,WGS84\n2,42,-85,EPSG:6318\n")
    assert len(log.packets) == 1
    assert "epsg:6318" in log.report.left_out[0].reason


def test_declared_columns() -> None:
    text = "a,b,c,d\n7,-85.6,42.2,1773668372000\n"
    declared = PacketDeclaration(columns={"number": "a", "lon": "b", "lat": "c", "time": "d"})
    assert read(text, declared).packets[0].received_at_s == AT_S
    with pytest.raises(InvalidParameter, match="no column 'e' for snr"):
        read(text, PacketDeclaration(columns={"number": "a", "lon": "b", "lat": "c", "snr": "e"}))
    with pytest.raises(ValidationError, match="colour"):
        PacketDeclaration(columns={"colour": "a"})


# --- times --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("written", "clock"),
    [
        (AT_S, LogClock()),
        (AT_S * 1e3, LogClock()),
        (int(AT_S * 1e6), LogClock()),
        (int(AT_S) * 10**9, LogClock()),
        (f"{AT_S:.3f}", LogClock()),
        ("2026-03-16 13:39:32", LogClock()),
        ("2026-03-16T09:39:32-04:00", LogClock()),
        ("2026-03-16t13:39:32z", LogClock()),  # RFC 3339, section 5.6
        ("2026-03-16T09:39:32", LogClock(utc_offset_s=-4 * 3600)),
        (1457703590, LogClock(scale=TimeScale.GPS_S)),
        (1457703590000, LogClock(scale=TimeScale.GPS_MS)),
        ("12.5", LogClock(scale=TimeScale.UNIX_S, offset_s=AT_S - 12.5)),
    ],
)
def test_times(written: object, clock: LogClock) -> None:
    assert clock.read(written) == pytest.approx(AT_S, abs=1e-6)


@pytest.mark.parametrize(
    "written", ["", "soon", "12.5", 0, True, math.nan, math.inf, 10**30, "0001-01-01T00:00:00Z", None, [], "1" * 30]
)
def test_no_times(written: object) -> None:
    assert math.isnan(LogClock().read(written))


def test_hemispheres_beside_degrees_without_a_sign() -> None:
    log = read("id,lat,N/S,lon,E/W\n1,33.5,S,70.6,W\n2,33.5,X,70.6,W\n")
    (packet,) = log.packets
    assert packet.claim is not None
    assert (packet.claim.lat_deg, packet.claim.lon_deg) == (-33.5, -70.6)
    assert "hemisphere" in log.report.left_out[0].reason


def test_gps_time_at_leap_seconds() -> None:
    # IERS bulletin C 52: UTC - TAI was -36 s until 2017-01-01, -37 s from then on; TAI - GPS is 19 s
    assert utc_from_gps_s(1_167_264_016) == datetime(2016, 12, 31, 23, 59, 59, tzinfo=UTC).timestamp()
    assert (
        utc_from_gps_s(1_167_264_017.5) == datetime(2017, 1, 1, microsecond=500_000, tzinfo=UTC).timestamp()
    )  # 23:59:60
    assert utc_from_gps_s(1_167_264_018) == datetime(2017, 1, 1, tzinfo=UTC).timestamp()
    assert utc_from_gps_s(0) == datetime(1980, 1, 6, tzinfo=UTC).timestamp()


def test_what_times_do_not_say_is_said() -> None:
    untimed = read("id,lat,lon,timestamp\n1,42,-85,12.5\n")
    assert "no time between 2000 and 2100" in untimed.report.warnings[0]
    local = read("id,lat,lon,timestamp\n1,42,-85,2026-03-16 13:39:32\n")
    assert "without a zone" in local.report.warnings[0]
    local = read('{"id": 1, "lat": 42, "lon": -85, "time": "2026-03-16 13:39:32"}\n')
    assert "without a zone" in local.report.warnings[0]
    for zone in ("Z", "+00", "+0000", "-05:00"):
        assert not read(f'{{"id": 1, "lat": 42, "lon": -85, "time": "2026-03-16 13:39:32{zone}"}}\n').report.warnings


@pytest.mark.parametrize(
    ("written", "day_first"),
    [
        ("01.06.2026 08:00:00", None),
        ("01.06.2026 08:00", None),
        ("01.06.2026, 08:00:00", None),
        ("1.6.2026 8:00", None),
        ("2026/06/01 08:00", None),
        ("06/01/2026 8:00 AM", False),
        ("6/1/2026, 8:00:00 a.m.", False),
        ("6/1/2026, 8:00:00\u202fAM", False),  # of browsers
        ("01/06/2026 08:00:00", True),
        ("01-06-2026 08:00:00", True),
    ],
)
def test_dates_of_spreadsheets(written: str, day_first: bool | None) -> None:
    clock = LogClock(utc_offset_s=7200, day_first=day_first)
    log = read(f"Zeit;RSSI;Payload\n{written};-50;{PAYLOAD.hex()}\n", PacketDeclaration(clock=clock))
    assert log.packets[0].received_at_s == datetime(2026, 6, 1, 6, 0, tzinfo=UTC).timestamp()
    assert not log.report.warnings
    assert math.isnan(clock.read(written.replace("01", "41").replace("1/", "41/").replace("1.6", "41.6")))


def test_the_order_of_day_and_month_is_found_or_asked_for() -> None:
    def table(*dates: str) -> str:
        return "time;payload\n" + "".join(f"{at};{PAYLOAD.hex()}\n" for at in dates)

    june_s = datetime(2026, 6, 1, 20, 0, tzinfo=UTC).timestamp()
    assert read(table("01/06/2026 20:00", "13/06/2026 20:00")).packets[0].received_at_s == june_s
    assert read(table("6/1/2026 8:00 PM", "6/13/2026 8:00 PM")).packets[0].received_at_s == june_s
    assert read(table("05/05/2026 12:00 AM")).packets[0].received_at_s == datetime(2026, 5, 5, tzinfo=UTC).timestamp()
    for dates in (("01/06/2026 08:00",), ("13/06/2026 08:00", "06/13/2026 08:00")):
        with pytest.raises(InvalidParameter, match="day or the month") as caught:
            read(table(*dates))
        assert caught.value.field == "clock.day_first"
        assert dates[0] in caught.value.message
        assert "2026-06-01T08:00:00Z" in str(caught.value.cure)
    shown = read(table("Montag um acht")).report.warnings[-1]
    assert "'Montag um acht'" in shown
    assert "2026-06-01T08:00:00Z" in shown
    unnamed = read(f"wann;payload\n2026-06-01T08:00:00Z;{PAYLOAD.hex()}\n").report.warnings[0]
    assert "'wann'" in unnamed
    assert "columns.time" in unnamed


# --- raw ----------------------------------------------------------------------------------------------------------


def test_raw_payloads() -> None:
    log = read(PAYLOAD * 3)
    assert payloads(log) == [PAYLOAD] * 3
    assert log.report.format == PacketFormat.RAW
    cut = read(PAYLOAD * 3 + PAYLOAD[:5])
    assert payloads(cut) == [PAYLOAD] * 3
    assert "last 5 bytes" in cut.report.left_out[0].reason
    assert payloads(read(PAYLOAD + b"\1")) == [PAYLOAD + b"\1"]  # refused by name when it is decoded
    assert payloads(read(b"\x24" + bytes(23))) == [b"\x24" + bytes(23)]


@pytest.mark.parametrize(
    "line",
    [
        PAYLOAD.hex(),
        f"2026-03-16T13:39:32Z {PAYLOAD.hex()} -110",
        f"{AT_S:.0f},{PAYLOAD.hex(' ')},-110",
        f"2026-03-16 13:39:32; 0x{PAYLOAD.hex().upper()}; -110.0",
    ],
)
def test_lines_of_hex(line: str) -> None:
    log = read(line + "\n" + line + "\n# the end\n")
    assert log.report.format == PacketFormat.HEX
    assert payloads(log) == [PAYLOAD] * 2
    if line != PAYLOAD.hex():
        assert (log.packets[1].received_at_s, log.packets[1].rssi_dbm) == (AT_S, -110.0)


def test_a_broken_line_of_hex() -> None:
    log = read(f"{PAYLOAD.hex()}\n{PAYLOAD.hex()[:-1]}\n{PAYLOAD.hex()}\nhello\n")
    assert payloads(log) == [PAYLOAD] * 2
    assert log.report.left_out_count == 2


# --- network servers ----------------------------------------------------------------------------------------------


def test_chirpstack() -> None:
    log = read(json.dumps(chirpstack(PAYLOAD), indent=2))
    (packet,) = log.packets
    assert log.report.format == UplinkKind.CHIRPSTACK
    assert packet.payload == PAYLOAD
    assert packet.received_at_s == pytest.approx(AT_S + 0.656322, abs=1e-5)
    assert (packet.rssi_dbm, packet.snr_db) == (-103.0, 0.0)  # the stronger gateway; its SNR of 0 is left out
    assert packet.device == "0101010101010107"
    assert packet.event == "e3eb5131-fb38-481a-b9df-000000000007"


def test_chirpstacks_times_where_some_are_missing() -> None:
    event = chirpstack(PAYLOAD)
    event["time"] = None
    event["rxInfo"] = event["rxInfo"][:1]
    for name, seconds in (("gwTime", 32.6), ("nsTime", 32.7), ("timeSinceGpsEpoch", 32.656)):
        (packet,) = read(json.dumps(event)).packets
        assert packet.received_at_s == pytest.approx(AT_S - 32 + seconds, abs=1e-5)
        event["rxInfo"][0][name] = None
    assert math.isnan(read(json.dumps(event)).packets[0].received_at_s)


def test_the_things_stack() -> None:
    log = read(json.dumps(things_stack(PAYLOAD)))
    (packet,) = log.packets
    assert log.report.format == UplinkKind.THINGS_STACK
    assert packet.payload == PAYLOAD
    assert packet.received_at_s == pytest.approx(datetime(2026, 5, 25, 13, 42, 11, 412680, UTC).timestamp(), abs=1e-5)
    assert (packet.rssi_dbm, packet.snr_db) == (-99.0, 0.0)
    assert packet.device == "70B3D57ED005B89A"
    assert packet.event == "70B3D57ED005B89A/AWNbm/4zfqx0jZ5q1NlBmw==/43"
    (first,) = read(json.dumps(things_stack(PAYLOAD, count=0))).packets
    assert first.event == "70B3D57ED005B89A/AWNbm/4zfqx0jZ5q1NlBmw==/0"


def test_the_best_gateway_of_the_things_stack_by_the_rssi_of_its_channel() -> None:
    event = things_stack(PAYLOAD)
    event["uplink_message"]["rx_metadata"] = [
        {"gateway_ids": {"gateway_id": "a"}, "rssi": -120, "channel_rssi": -120, "snr": -12.2},
        {"gateway_ids": {"gateway_id": "b"}, "channel_rssi": -98, "snr": 4.5},
    ]
    (packet,) = read(json.dumps(event)).packets
    assert (packet.rssi_dbm, packet.snr_db) == (-98.0, 4.5)


def test_the_things_stacks_storage_as_documented() -> None:
    log = read(STORED + "\n" + STORED.replace('"f_cnt":43', '"f_cnt":44') + "\n")
    assert payloads(log) == [bytes.fromhex("010a010a010a010a")] * 2
    assert [p.event for p in log.packets] == [f"1111111111111111/AXPoziFRvbcEguvZQoCCZw==/{n}" for n in (43, 44)]
    assert math.isnan(log.packets[0].rssi_dbm)


EVENTS = [chirpstack(PAYLOAD, count=n) for n in range(3)]
TOPIC = "application/ca739e26/device/0101010101010107/event/up"


@pytest.mark.parametrize(
    "text",
    [
        json.dumps(EVENTS),
        json.dumps(EVENTS, indent=1),
        "\n".join(json.dumps(event) for event in EVENTS),
        "\n".join(json.dumps(event, indent=4) for event in EVENTS),
        json.dumps({"events": EVENTS}),
        "\n".join(f"{TOPIC} {json.dumps(event)}" for event in EVENTS),
        "\n".join(f"event: up\ndata: {json.dumps(event)}\n" for event in EVENTS),
        "\n".join(json.dumps({"topic": TOPIC, "received_at": "2026-03-16T13:39:32Z", "payload": e}) for e in EVENTS),
        "\n".join(json.dumps({"topic": TOPIC, "qos": 1, "payload": json.dumps(e)}) for e in EVENTS),
    ],
)
def test_events_as_they_are_stored(text: str) -> None:
    log = read(text)
    assert payloads(log) == [PAYLOAD] * 3
    assert [p.entry for p in log.packets] == [0, 1, 2]
    assert log.report.format == UplinkKind.CHIRPSTACK
    assert not log.report.left_out


def test_a_sequence_of_json_texts() -> None:
    text = "".join(f"\x1e{json.dumps(event)}\n" for event in EVENTS)  # RFC 7464
    assert payloads(read(text)) == [PAYLOAD] * len(EVENTS)


def test_an_event_in_a_console_stream() -> None:
    event = {"name": "as.up.data.forward", "time": "2026-05-25T13:42:12Z", "data": things_stack(PAYLOAD)}
    assert payloads(read(json.dumps([event]))) == [PAYLOAD]


BASE64 = base64.b64encode(PAYLOAD).decode()
UPLINKS: dict[UplinkKind, dict[str, Any]] = {
    UplinkKind.THINGS_NETWORK: {
        "app_id": "road", "dev_id": "cerpm-7", "hardware_serial": "0101010101010107", "port": 1, "counter": 2,
        "payload_raw": BASE64, "payload_fields": {},
        "metadata": {
            "time": "2026-03-16T13:39:32.000000001Z", "frequency": 868.1, "modulation": "LORA", "data_rate": "SF7BW125",
            "coding_rate": "4/5",
            "gateways": [
                {"gtw_id": "eui-1", "timestamp": 1, "time": "", "channel": 0, "rssi": -110, "snr": -3},
                {"gtw_id": "eui-2", "timestamp": 1, "time": "", "channel": 0, "rssi": -60, "snr": 7.2},
            ],
        },
    },
    UplinkKind.LORIOT: {
        "cmd": "rx", "seqno": 12, "EUI": "0101010101010107", "ts": int(AT_S * 1e3), "fcnt": 1, "port": 1,
        "freq": 868100000, "rssi": -60, "snr": 7.2, "toa": 61, "dr": "SF7 BW125 4/5", "ack": False, "bat": 255,
        "offline": False, "data": PAYLOAD.hex(),
    },
    UplinkKind.HELIUM: {
        "app_eui": "6081F9BF908E2EA0", "dev_eui": "0101010101010107", "devaddr": "9C000148", "fcnt": 2, "port": 2,
        "hotspots": [
            {"channel": 1, "frequency": 904.1, "name": "a", "reported_at": int(AT_S * 1e3), "rssi": -60, "snr": 7.2}
        ],
        "id": "e1", "name": "cerpm-7", "payload": BASE64, "payload_size": 24, "reported_at": int(AT_S * 1e3),
        "type": "uplink", "uuid": "2d7d3a6f-e5a5-4d0e-b0d1-d1bd0d70a7f1",
    },
    UplinkKind.AWS: {
        "MessageId": "m", "WirelessDeviceId": "d", "PayloadData": BASE64,
        "WirelessMetadata": {
            "LoRaWAN": {
                "DevEui": "0101010101010107", "FCnt": 1, "FPort": 2, "Frequency": "868100000", "DataRate": "5",
                "Gateways": [{"GatewayEui": "80029cfffe5cf1cc", "Rssi": -60, "Snr": 7.2}],
                "Timestamp": "2026-03-16T13:39:32Z",
            }
        },
    },
    UplinkKind.ACTILITY: {
        "DevEUI_uplink": {
            "Time": "2026-03-16T14:39:32.000+01:00", "DevEUI": "0101010101010107", "FPort": "2", "FCntUp": "7",
            "MType": "2", "payload_hex": PAYLOAD.hex(), "mic_hex": "38e7a3b9", "Lrcid": "00000065",
            "LrrRSSI": "-60.000000", "LrrSNR": "7.2", "SpFact": "7", "CustomerID": "100000507",
        }
    },
    UplinkKind.SEMTECH: {
        "rxpk": [
            {
                "time": "2026-03-16T13:39:32.000000Z", "tmst": 3512348611, "chan": 2, "rfch": 0, "freq": 866.349812,
                "stat": 1, "modu": "LORA", "datr": "SF7BW125", "codr": "4/6", "rssi": -60, "lsnr": 7.2, "size": 24,
                "data": BASE64,
            }
        ]
    },
}  # fmt: skip


@pytest.mark.parametrize("kind", UPLINKS)
def test_uplinks_of_other_servers(kind: UplinkKind) -> None:
    event = UPLINKS[kind]
    for text in (json.dumps(event), json.dumps([event]), f"topic {json.dumps(event)}\n"):
        log = read(text)
        assert log.report.format == kind
        (packet,) = log.packets
        assert packet.payload == PAYLOAD
        assert packet.received_at_s == pytest.approx(AT_S, abs=1e-3)
        assert (packet.rssi_dbm, packet.snr_db) == (-60.0, 7.2)
        assert packet.device == (None if kind is UplinkKind.SEMTECH else "0101010101010107")
        assert not log.report.warnings
    clock = LogClock(offset_s=3.0)
    assert read(json.dumps(event), PacketDeclaration(clock=clock)).packets[0].received_at_s == pytest.approx(AT_S + 3)


def test_one_uplink_of_loriot_comes_twice() -> None:
    rx = UPLINKS[UplinkKind.LORIOT]
    gateways = [{"rssi": -113, "snr": -9.2, "gweui": "A"}, {"rssi": -50, "snr": 8.0, "gweui": "B"}]
    gw = {name: value for name, value in rx.items() if name not in ("rssi", "snr")} | {"cmd": "gw", "gws": gateways}
    first, second = read(json.dumps(rx) + "\n" + json.dumps(gw)).packets
    assert first.event == second.event
    assert (second.rssi_dbm, second.snr_db) == (-50.0, 8.0)


def test_datagrams_of_gateways() -> None:
    (packet,) = UPLINKS[UplinkKind.SEMTECH]["rxpk"]
    gps = {name: value for name, value in packet.items() if name != "time"} | {"tmms": 1457703590000}
    frame = packet | {"data": base64.b64encode(b"\x40" + bytes(36)).decode()}
    broken = packet | {"stat": -1}
    lines = [{"rxpk": [packet, gps], "stat": {"rxnb": 2}}, {"rxpk": [frame]}, {"rxpk": [broken, packet]}]
    log = read("\n".join(json.dumps(line) for line in lines))
    enveloped = [{"topic": "up", "payload": json.dumps(lines[0])}, {"topic": "up", "payload": lines[0]}]
    assert len(read("\n".join(json.dumps(line) for line in enveloped)).packets) == 4
    assert [one.entry for one in log.packets] == [0, 1, 4]
    assert [one.received_at_s for one in log.packets] == [AT_S] * 3
    assert [left.entry for left in log.report.left_out] == [2, 3]
    assert "network server" in log.report.left_out[0].reason
    assert "checksum" in log.report.left_out[1].reason


def test_what_is_no_uplink_of_other_servers_is_named() -> None:
    loriot, actility = UPLINKS[UplinkKind.LORIOT], UPLINKS[UplinkKind.ACTILITY]
    events: list[tuple[dict[str, Any], str]] = [
        ({"cmd": "txd", "EUI": "01", "seqdn": 3}, "txd"),
        (loriot | {"data": "", "encdata": "0102"}, "encrypted"),
        (UPLINKS[UplinkKind.HELIUM] | {"type": "join"}, "join"),
        ({"WirelessMetadata": {"Sidewalk": {"Seq": 1}}, "PayloadData": BASE64}, "LoRaWAN"),
        ({"DevEUI_location": {"DevEUI": "01"}}, "DevEUI_location"),
        ({"DevEUI_uplink": actility["DevEUI_uplink"] | {"payload_encryption": "1"}}, "encrypted"),
        (UPLINKS[UplinkKind.THINGS_NETWORK] | {"payload_raw": ""}, "without a payload"),
    ]
    log = read("\n".join(json.dumps(event) for event in [*(event for event, _reason in events), loriot]))
    assert len(log.packets) == 1
    for left, (_event, reason) in zip(log.report.left_out, events, strict=True):
        assert reason in left.reason


def test_what_is_no_uplink_is_named() -> None:
    join = {k: v for k, v in things_stack(PAYLOAD).items() if k != "uplink_message"} | {"join_accept": {}}
    simulated = things_stack(PAYLOAD) | {"simulated": True}
    status = {k: v for k, v in chirpstack(PAYLOAD).items() if k not in ("rxInfo", "data")} | {"margin": 7}
    empty = {k: v for k, v in chirpstack(PAYLOAD).items() if k != "data"}
    old = {"applicationID": "1", "devEUI": "AgICAgICAgI=", "rxInfo": [], "data": "MQ=="}
    encrypted = chirpstack(PAYLOAD) | {"joinServerContext": {"sessionKeyId": "AWNb"}}
    error = {"error": {"code": 5, "message": "not found"}}
    other = {"temperature": 21.5}
    events = [chirpstack(PAYLOAD), join, simulated, status, empty, old, encrypted, error, other, 17, None]
    log = read("\n".join(json.dumps(event) for event in events))
    assert len(log.packets) == 1
    assert log.report.left_out_count == 10
    said = " | ".join(left.reason for left in log.report.left_out)
    for words in (
        "join_accept", "simulated", "no uplink", "without a payload", "v3 or older", "encrypted", "not found",
        "neither",
    ):  # fmt: skip
        assert words in said


# --- traps --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "broken",
    [
        '{"payload": "z!"}',
        '{"payload": {"a": ' * 400 + "1" + "}}" * 400,
        '{"a":' * 100_000,
        "[" * 100_000,
        '{"id": 1, "id": 2, "lat": 42, "lon": -85}',
        '{"id": 1, "lat": NaN, "lon": -85}',
        '{"id": 1, "lat": 42, "lon": -Infinity}',
        '{"id": 1, "lat": 1e999, "lon": -85}',
        '{"id": 111111111111111111111111, "lat": 42, "lon": -85}',
        '{"id": ' + "1" * 5000 + ', "lat": 42, "lon": -85}',
        '{"id": true, "lat": 42, "lon": -85}',
        '{"id": 1, "lat": [42], "lon": {"a": 1}}',
        '{"id": 1, "lat": "4_2", "lon": -85}',
        '{"payload": [300, 1]}',
        '{"payload": "' + "A" * 300_000 + '"}',
        '{"id": 1, "lat": 42,',
        '{"topic": "x", "payload": "{broken"}',
        '{"payload": 7.5}',
        '{"deduplicationId": [], "deviceInfo": 3, "rxInfo": [3, null, {"rssi": "loud"}], "data": 17}',
        '{"end_device_ids": 4, "uplink_message": {"frm_payload": "AA==", "rx_metadata": {}, "f_cnt": {}}, "simulated": 1}',  # noqa: E501
        "\0\0\0",
    ],
)
def test_a_broken_line_costs_only_itself(broken: str) -> None:
    good = json.dumps({"payload": PAYLOAD.hex(), "time": AT_S})
    for text in (f"{good}\n{broken}\n{good}\n", f"{broken}\n{good}\n{good}"):
        log = read(text)
        assert payloads(log) == [PAYLOAD] * 2
        assert log.report.left_out_count == 1
        assert log.report.left_out[0].reason


def test_odd_texts_are_made_fit_to_store() -> None:
    event = json.dumps(chirpstack(PAYLOAD)).replace("0101010101010107", "\\ud800\\u0000" + "x" * 1000)
    (packet,) = read(event).packets
    assert packet.device is not None
    assert packet.device.startswith("??xxx")
    assert len(packet.device) <= 120


def test_a_file_of_no_known_format_names_what_is_expected() -> None:
    for content in (
        b"hello, world\n",
        b"PK\3\4" + bytes(92),
        b"\x89PNG\r\n\x1a\n" + bytes(88),
        b"\xff" * 25,
        b"<html></html>",
    ):
        with pytest.raises(UnsupportedUpload, match="no format that packet logs") as caught:
            read(content)
        assert caught.value.limit
        assert "ChirpStack v4" in caught.value.limit
    with pytest.raises(UnsupportedUpload, match="'speed', 'colour'"):
        read("speed,colour\n1,2\n")


def test_files_without_a_single_packet() -> None:
    for content in (
        b"",
        b" \n\n",
        b"\xff\xfe\x00",
        b'{"a": 1}',
        b"[[1], 2]",
        PAPER.split("\n", 1)[0].encode() + b"\nx\n",
    ):
        with pytest.raises(UnreadableUpload):
            read(content)
    assert read(PAPER.split("\n", 1)[0] + "\n").packets == []
    assert read("[]").packets == []


def test_limits() -> None:
    with pytest.raises(UploadTooLarge, match="bytes"):
        read(PAPER, file_bytes=10)
    with pytest.raises(UploadTooLarge, match="too many"):
        read(PAPER, packets=1)
    with pytest.raises(UploadTooLarge, match="one JSON document"):
        read(json.dumps(EVENTS, indent=1), document_bytes=100)
    assert len(read("\n".join(json.dumps(e) for e in EVENTS), document_bytes=100).packets) == 3


@pytest.mark.parametrize(
    "text",
    [
        "id,latitude,longitude,rssi,timestamp\n" + "7,42.2834567,-85.6123456,-108,2026-03-16T13:39:32Z\n" * 20_000,
        (json.dumps({"payload": PAYLOAD.hex(), "time": AT_S}) + "\n") * 20_000,
        (f"2026-03-16T13:39:32Z {PAYLOAD.hex()} -110\n") * 20_000,
        '{"a":"\n' * 20_000 + json.dumps({"payload": PAYLOAD.hex()}),
        "[\n" * 20_000 + json.dumps({"payload": PAYLOAD.hex()}),
        '"' + "id,latitude,longitude\n" + '"7,42,-85\n' * 20_000 + "7,42,-85\n",
    ],
    ids=["csv", "json", "hex", "open-texts", "open-arrays", "open-quotes"],
)
def test_long_logs_take_a_second(text: str) -> None:
    began = process_time()
    try:
        read(text)
    except UnreadableUpload:
        assert text[0] == '"'
    assert process_time() - began < 3
