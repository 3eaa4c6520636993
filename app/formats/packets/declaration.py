"""What is declared of a packet log, and the limits of reading one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from app.errors import InvalidParameter
from app.formats.format import Sample
from app.formats.log_report import LogReport
from app.formats.log_times import LogClock
from app.formats.packets.rows import ALIASES, PayloadText

FIELD = "file"


class PacketFormat(StrEnum):
    """Formats of packet logs."""

    CSV = "csv"
    JSON = "json"
    CHIRPSTACK = "chirpstack-v4"
    THINGS_STACK = "things-stack-v3"
    RAW = "raw-payloads"
    HEX = "hex-lines"


@dataclass(frozen=True, slots=True)
class PacketDeclaration:
    """What the uploader declares of a log; everything is optional.

    Attributes
    ----------
    clock : LogClock
    columns : mapping of str to str
        Names of columns in place of the usual ones, by quantity: payload, number, lon, lat, height, rssi, snr, time,
        side, speed_km_h, speed_mph, device, event, crs.
    payload_text : PayloadText
        How the payload column is written; `auto` takes what gives 24 bytes.

    Raises
    ------
    InvalidParameter
        A quantity is not one of these.
    """

    clock: LogClock = field(default_factory=LogClock)
    columns: Mapping[str, str] = field(default_factory=dict)
    payload_text: PayloadText = PayloadText.AUTO

    def __post_init__(self) -> None:
        unknown = sorted(set(self.columns) - set(ALIASES))
        if unknown:
            raise InvalidParameter(
                f"there is no quantity {unknown[0]!r} in a packet log", field="columns", limit=", ".join(ALIASES)
            )


@dataclass(frozen=True, slots=True)
class PacketLimits:
    """Limits of reading a log.

    Attributes
    ----------
    file_bytes : int
        Largest file. [byte]
    document_bytes : int
        Largest single JSON document; JSON lines may be longer together. [byte]
    packets : int
    """

    file_bytes: int = 64 * 1024**2
    document_bytes: int = 16 * 1024**2
    packets: int = 500_000


@dataclass(frozen=True, slots=True)
class PacketSource:
    """A packet log while it is read.

    Attributes
    ----------
    sample : Sample
        All of the file.
    declaration : PacketDeclaration
    limits : PacketLimits
    report : LogReport
        Filled while packets are read.
    """

    sample: Sample
    declaration: PacketDeclaration
    limits: PacketLimits
    report: LogReport
