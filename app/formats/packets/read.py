"""Packets of an uploaded packet log. Its content decides which format it has, never its name."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import islice

from app.errors import UnreadableUpload, UnsupportedUpload, UploadTooLarge
from app.formats.format import Sample, detect_format, list_accepted
from app.formats.log_report import LogReport
from app.formats.packets.csv_log import missing_columns
from app.formats.packets.declaration import FIELD, PacketDeclaration, PacketLimits, PacketSource
from app.formats.packets.formats import PACKET_FORMATS, find_other_format
from app.formats.packets.rows import warn_untimed
from app.formats.text import clean_text
from app.sensors.receiver import ReceivedPacket

EXPECTED = list_accepted(PACKET_FORMATS)
_CURE = "export the log in one of these formats; a CSV needs the names of its columns in its first line"


@dataclass(frozen=True, slots=True)
class PacketLog:
    """Packets of a log, and the report about reading it."""

    packets: list[ReceivedPacket]
    report: LogReport


def read_packets(
    name: str, data: bytes, declaration: PacketDeclaration | None = None, limits: PacketLimits | None = None
) -> PacketLog:
    """Read a packet log of any known format.

    Parameters
    ----------
    name : str
        Of the file, for messages only.
    data : bytes
    declaration : PacketDeclaration, optional
    limits : PacketLimits, optional

    Returns
    -------
    PacketLog
        In the order of the file. An entry that cannot be read is left out and counted.

    Raises
    ------
    UploadTooLarge
        More bytes or packets than the limits.
    UnsupportedUpload
        The format is unknown; the message lists the accepted ones.
    UnreadableUpload
        Empty, of an encoding that cannot be read, or no single entry can be read.
    InvalidParameter
        A declared column is not there.
    """
    declaration, limits = declaration or PacketDeclaration(), limits or PacketLimits()
    name = clean_text(name) or "the file"
    if not data.strip(b" \t\r\n"):
        raise UnreadableUpload(f"{name} is empty", field=FIELD, limit="at least one packet", cure="send the log whole")
    if len(data) > limits.file_bytes:
        raise UploadTooLarge(
            f"{name} has {len(data)} bytes",
            field=FIELD,
            limit=f"{limits.file_bytes} bytes",
            cure="cut the log into several",
        )
    source = PacketSource(Sample(name, data, declaration.columns), declaration, limits, LogReport())
    packets = list(islice(_read_any(source), limits.packets + 1))
    if len(packets) > limits.packets:
        raise UploadTooLarge(
            f"{name} holds too many packets", field=FIELD, limit=f"{limits.packets}", cure="cut the log into several"
        )
    _check_outcome(name, packets, source.report)
    return PacketLog(packets, source.report)


def _read_any(source: PacketSource) -> Iterable[ReceivedPacket]:
    sample = source.sample
    if sample.is_text and sample.decoded[1] is not None:
        source.report.warn(sample.decoded[1])
    found = detect_format(sample, PACKET_FORMATS)
    if found is not None:
        source.report.format = found.name
        return found.read(source)
    if sample.is_text and sample.declared:
        raise missing_columns(source, sample.declared)
    raise _unsupported(sample)


def _check_outcome(name: str, packets: list[ReceivedPacket], report: LogReport) -> None:
    if not packets and report.left_out:
        first = report.left_out[0]
        raise UnreadableUpload(
            f"none of the {report.entries} entries of {name} can be read; entry {first.entry}: {first.reason}",
            field=FIELD,
            limit=EXPECTED,
            cure=_CURE,
        )
    untimed = sum(1 for packet in packets if math.isnan(packet.received_at_s))
    warn_untimed(report, len(packets), untimed)


def _unsupported(sample: Sample) -> UnsupportedUpload:
    other = find_other_format(sample.data)
    columns = sample.log.columns[:12] if sample.is_text else ()
    shown = ", ".join(repr(clean_text(column, 40)) for column in columns if clean_text(column, 40))
    what = f" ({other})" if other else f"; its first line is {shown}" if shown else ""
    return UnsupportedUpload(
        f"{sample.name} has no format that packet logs are read in{what}", field=FIELD, limit=EXPECTED, cure=_CURE
    )
