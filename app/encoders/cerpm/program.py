"""Programs of CERPMs, and a table for programming many."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field

from app.encoders.cerpm.payload import encode_body
from app.errors import InvalidParameter
from app.formats.spreadsheet import TableWriter
from app.markers.cerpm import KEY_BYTES, CerpmMessage, LaneSide, SpeedUnit
from app.radio.settings import RadioSettings

SEQUENCE_AT = 16  # [bytes] first of the four bytes of the sequence; source: docs/cerpm-message.md
MAX_PROGRAMS = 100_000  # source: by hand, bounds the size of a table
COLUMNS = (
    "number", "lon_deg", "lat_deg", "height_m", "side", "speed_limit", "speed_unit", "body_hex", "sequence_start",
    "interval_s", "jitter_share", "frequency_hz", "channels", "hopping", "spreading_factor", "bandwidth_hz",
    "coding_rate", "preamble_symbols", "explicit_header", "crc", "power_dbm", "lorawan",
)  # fmt: skip
KEY_COLUMN = "key_hex"


@dataclass(frozen=True, slots=True)
class MarkerProgram:
    """Program of one marker.

    Parameters
    ----------
    message : CerpmMessage
        The first one: its sequence is above all that the marker ever sent.
    key : bytes
        The marker's own, 16 bytes; not shown by `repr`.
    radio : RadioSettings

    Raises
    ------
    InvalidParameter
        The key has another length.
    """

    message: CerpmMessage
    key: bytes = field(repr=False)
    radio: RadioSettings

    def __post_init__(self) -> None:
        if len(self.key) != KEY_BYTES:
            raise InvalidParameter(f"a marker's key has {len(self.key)} bytes", field="key", limit=f"{KEY_BYTES} bytes")

    @property
    def body(self) -> bytes:
        """Bytes 0 to 19 of the first message; the marker counts bytes 16 to 19 up and adds the tag itself."""
        return encode_body(self.message)


def write_programs_csv(programs: Sequence[MarkerProgram], *, with_keys: bool = False) -> str:
    """Table for programming many markers: a header, then one row a marker.

    Parameters
    ----------
    programs : sequence of MarkerProgram
        Of one agency: numbers differ. At most 100,000.
    with_keys : bool
        Add the column ``key_hex``. Whoever has such a table can send for its markers: give it only to the
        programming station.

    Returns
    -------
    str
        CSV with CRLF. Positions as they are sent, to 1e-7 degrees and 0.1 m.

    Raises
    ------
    InvalidParameter
        Two programs have one number, or there are too many.
    """
    if len(programs) > MAX_PROGRAMS:
        raise InvalidParameter(
            f"{len(programs)} markers in one table", field="programs", limit=f"at most {MAX_PROGRAMS}", cure="split it"
        )
    seen: set[int] = set()
    for program in programs:
        if program.message.number in seen:
            raise InvalidParameter(
                f"two markers have the number {program.message.number}",
                field="programs",
                limit="one marker a number",
                cure="a number belongs to one marker for ever; give the other a new one",
            )
        seen.add(program.message.number)
    stream = io.StringIO()
    writer = TableWriter(stream)
    writer.write_row([*COLUMNS, KEY_COLUMN] if with_keys else COLUMNS)
    for program in programs:
        row = _row(program)
        writer.write_row([*row, program.key.hex()] if with_keys else row)
    return stream.getvalue()


def _row(program: MarkerProgram) -> list[object]:
    message, radio, body = program.message, program.radio, program.body
    limit = message.speed_limit
    return [
        message.number,
        f"{int.from_bytes(body[5:9], signed=True) / 1e7:.7f}",
        f"{int.from_bytes(body[9:13], signed=True) / 1e7:.7f}",
        "" if message.height_m is None else f"{(int.from_bytes(body[13:15]) - 10_000) / 10:.1f}",
        LaneSide(message.side).name.lower(),
        "" if limit is None else int(limit.value),
        "" if limit is None else SpeedUnit(limit.unit).value,
        body.hex(),
        message.sequence,
        f"{radio.interval_s:g}",
        f"{radio.jitter_share:g}",
        radio.frequency_hz,
        radio.channels,
        str(radio.hopping).lower(),
        radio.spreading_factor,
        radio.bandwidth_hz,
        f"4/{radio.coding_rate}",
        radio.preamble_symbols,
        str(radio.explicit_header).lower(),
        str(radio.crc).lower(),
        f"{radio.power_dbm:g}",
        str(radio.lorawan).lower(),
    ]
