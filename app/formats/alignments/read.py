"""Files with roads: the format is detected by the content."""

from __future__ import annotations

from app.errors import InvalidParameter, UnsupportedUpload
from app.formats.alignments.formats import ALIGNMENT_FORMATS
from app.formats.alignments.geometry import AlignmentFile
from app.formats.format import Sample, detect_format, list_accepted


def read_alignment(data: bytes, name: str = "", *, format: str | None = None) -> AlignmentFile:
    """Read a road of any format.

    Parameters
    ----------
    data : bytes
    name : str
        Of the file, for messages.
    format : str, optional
        Name of a format in `ALIGNMENT_FORMATS`; detected by the content if it is left out.

    Raises
    ------
    UnsupportedUpload, UnreadableUpload
        The file is of no format that is read here, is damaged, or has no lanes.
    InvalidParameter, ReferenceSystemError
        A feature or the CRS of the file cannot be used.
    """
    if format is None:
        found = detect_format(Sample(name, data), ALIGNMENT_FORMATS)
    else:
        found = next((known for known in ALIGNMENT_FORMATS if known.name == format), None)
        if found is None:
            names = ", ".join(known.name for known in ALIGNMENT_FORMATS)
            raise InvalidParameter(
                f"there is no format {format[:40]!r}", field="format", limit=names, cure="leave it out to detect it"
            )
    if found is None:
        raise UnsupportedUpload(
            f"the file {name[:80]!r} has no format that roads are read in" if name else "the file has no such format",
            field="file",
            limit=list_accepted(ALIGNMENT_FORMATS),
            cure="export it again in one of these formats",
        )
    return found.read(data)
