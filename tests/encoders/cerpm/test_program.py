"""What markers are programmed with, LoRaWAN's room, and the explanation of bytes."""

from __future__ import annotations

import csv
import io

import pytest

from app.encoders.cerpm import MarkerProgram, encode_message, explain_payload, write_programs_csv
from app.errors import InvalidParameter
from app.markers.cerpm import CerpmMessage, LaneSide, SpeedLimit, derive_marker_key, message_tag
from app.radio.settings import RadioSettings

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
