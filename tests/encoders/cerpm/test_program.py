"""What markers are programmed with, LoRaWAN's room, and the explanation of bytes."""

from __future__ import annotations

import csv
import io

import pytest

from app.encoders.cerpm import (
    MarkerProgram,
    RadioSettings,
    Region,
    encode_message,
    explain_payload,
    time_on_air_s,
    wrap_uplink,
    write_programs_csv,
)
from app.errors import InvalidParameter
from app.markers.cerpm import CerpmMessage, LaneSide, SpeedLimit
from app.markers.cerpm_keys import derive_marker_key, message_tag

AGENCY_KEY = bytes(range(32))


def make_program(number: int = 7, **fields: object) -> MarkerProgram:
    values: dict[str, object] = {"lon_deg": 8.5417, "lat_deg": 47.3769, "height_m": 455.25, "side": LaneSide.LEFT}
    message = CerpmMessage(number=number, **(values | fields))  # type: ignore[arg-type]
    return MarkerProgram(message, derive_marker_key(AGENCY_KEY, number), RadioSettings(interval_s=1.5))


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text, newline="")))


def test_a_programmed_marker_sends_what_the_encoder_says() -> None:
    program = make_program(speed_limit=SpeedLimit(80), sequence=41)
    (row,) = rows_of(write_programs_csv([program], with_keys=True))
    body, key = bytearray.fromhex(row["body_hex"]), bytes.fromhex(row["key_hex"])
    body[16:20] = (int(row["sequence_start"]) + 1).to_bytes(4)
    later = CerpmMessage(7, 8.5417, 47.3769, 455.25, LaneSide.LEFT, SpeedLimit(80), 42)
    assert bytes(body) + message_tag(key, bytes(body)) == encode_message(later, program.key)


def test_positions_in_the_table_are_those_that_are_sent() -> None:
    (row,) = rows_of(write_programs_csv([make_program(lon_deg=-0.12345678, height_m=-3.25)]))
    assert (row["lon_deg"], row["lat_deg"], row["height_m"]) == ("-0.1234568", "47.3769000", "-3.2")
    assert (row["side"], row["speed_limit"], row["speed_unit"]) == ("left", "", "")
    assert (row["interval_s"], row["bandwidth_hz"], row["coding_rate"]) == ("1.5", "500000", "4/5")


def test_keys_are_in_the_table_on_request_only() -> None:
    program = make_program()
    assert program.key.hex() not in write_programs_csv([program])
    assert "key" not in write_programs_csv([program])
    assert program.key.hex() in write_programs_csv([program], with_keys=True)
    assert str(program.key) not in repr(program)
    assert program.key.hex() not in repr(program)


def test_two_markers_with_one_number_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="number 7") as caught:
        write_programs_csv([make_program(7), make_program(8), make_program(7, lon_deg=8.6)])
    assert caught.value.field == "programs"


def test_no_markers_is_a_header() -> None:
    assert write_programs_csv([]).count("\r\n") == 1


def test_a_short_key_programs_nothing() -> None:
    with pytest.raises(InvalidParameter) as caught:
        MarkerProgram(make_program().message, b"short", RadioSettings())
    assert caught.value.field == "key"


def test_a_sequence_lasts_longer_than_a_marker() -> None:
    assert make_program().last_sequence_years == pytest.approx(204.15, abs=0.01)


# --- LoRaWAN ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("region", "data_rate", "spreading_factor", "bandwidth_hz"),
    [
        (Region.US915, 1, 9, 125_000),
        (Region.US915, 3, 7, 125_000),
        (Region.US915, 4, 8, 500_000),
        (Region.EU868, 0, 12, 125_000),
        (Region.EU868, 6, 7, 250_000),
    ],
)
def test_lorawan_adds_13_bytes(region: Region, data_rate: int, spreading_factor: int, bandwidth_hz: int) -> None:
    program = make_program()
    payload = encode_message(program.message, program.key)
    uplink = wrap_uplink(payload, region, data_rate)
    assert (uplink.payload, uplink.frame_bytes, uplink.f_port) == (payload, 37, 24)
    assert uplink.time_on_air_s == time_on_air_s(37, spreading_factor, bandwidth_hz)


@pytest.mark.parametrize(
    ("region", "data_rate", "mac_bytes", "field"),
    [
        (Region.US915, 0, 0, "data_rate"),
        (Region.US915, 5, 0, "data_rate"),
        (Region.EU868, 7, 0, "data_rate"),
        (Region.US915, -1, 0, "data_rate"),
        (Region.US915, 1, 16, "mac_command_bytes"),
    ],
)
def test_data_rates_without_room_are_refused(region: Region, data_rate: int, mac_bytes: int, field: str) -> None:
    with pytest.raises(InvalidParameter) as caught:
        wrap_uplink(bytes(24), region, data_rate, mac_command_bytes=mac_bytes)
    assert caught.value.field == field


def test_the_refusal_of_dr0_names_those_that_fit() -> None:
    with pytest.raises(InvalidParameter, match="room for 11") as caught:
        wrap_uplink(bytes(24), Region.US915, 0)
    assert caught.value.limit is not None
    assert "DR1, DR2, DR3, DR4" in caught.value.limit


# --- explanation --------------------------------------------------------------------------------------------------


def test_every_byte_is_explained_once() -> None:
    payload = encode_message(make_program().message, make_program().key)
    rows = explain_payload(payload)
    assert b"".join(bytes.fromhex(row.hex) for row in rows) == payload
    assert [row.offset for row in rows] == [0, 1, 5, 9, 13, 15, 16, 20]


def test_wrong_bytes_are_explained_not_refused() -> None:
    payload = bytes([0xFD, 0, 0, 0, 0, *b"\x7f\xff\xff\xff" * 2, *bytes(11)])
    values = {row.field: row.value for row in explain_payload(payload, bytes(16))}
    assert "unknown" in values["head"]
    assert "reserved" in values["head"]
    assert "side 3" in values["head"]
    assert "not in use" in values["number"]
    assert "off the globe" in values["longitude"]
    assert "off the globe" in values["latitude"]
    assert "not of this key" in values["tag"]


def test_the_tag_is_checked_where_the_key_is_known() -> None:
    program = make_program()
    payload = encode_message(program.message, program.key)
    assert explain_payload(payload, program.key)[-1].value == "the marker's own"
    assert "not of this key" in explain_payload(payload, derive_marker_key(AGENCY_KEY, 8))[-1].value


@pytest.mark.parametrize("length", [0, 23, 25])
def test_other_lengths_are_not_explained(length: int) -> None:
    with pytest.raises(InvalidParameter):
        explain_payload(bytes(length))
