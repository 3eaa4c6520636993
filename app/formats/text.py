"""Text of uploaded files: its encoding, its lines, and texts that can be stored and shown."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator

from app.errors import UnreadableUpload

MAX_LINE = 1 << 18
"""Longest line that is read; longer ones are left out. [character] Chosen by hand; no measurement kept."""
MAX_NAME = 120
"""Longest name of a file or a column that is shown. [character] Chosen by hand."""
_SAMPLE_BYTES = 4096  # [byte] by which text is recognized; chosen by hand
_DECODED_BYTES = 1 << 20  # [byte] checked at a time, to bound memory
_MAX_CONTROL_SHARE = 0.02  # [1] of the sample; chosen by hand: a damaged line or two, far below random bytes (0.11)
_BOMS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_C1_CONTROL = re.compile(rb"[\x80-\x9f]")  # printable in Windows-1252, never in ISO 8859-1
_CONTROL = re.compile(rb"[\x00-\x08\x0b\x0c\x0e-\x1f]")
_BLANK = "\r \t\ufeff"


def is_text(data: bytes) -> bool:
    """Whether bytes look like text: a byte order mark, or hardly any control characters at the beginning."""
    if data.startswith(tuple(bom for bom, _name in _BOMS)):
        return True
    sample = data[:_SAMPLE_BYTES]
    return len(_CONTROL.findall(sample)) <= len(sample) * _MAX_CONTROL_SHARE


def is_clean_text(data: bytes) -> bool:
    """Whether bytes look like text in ASCII or UTF-8: no control character at all at the beginning."""
    sample = data[:_SAMPLE_BYTES]
    return _CONTROL.search(sample) is None and b"\x7f" not in sample


def decode_text(name: str, data: bytes) -> tuple[str, str | None]:
    """Text of a file, and a warning about its encoding or None.

    Raises
    ------
    UnreadableUpload
        The file begins with a byte order mark and continues in another encoding.
    """
    for bom, encoding in _BOMS:
        if data.startswith(bom):
            try:
                return data.decode(encoding), None
            except UnicodeDecodeError as error:
                raise UnreadableUpload(
                    f"{name} begins as {encoding} and continues in another encoding",
                    field="file",
                    limit="UTF-8",
                    cure="save the file as UTF-8",
                ) from error
    try:
        return data.decode("utf-8"), None
    except UnicodeDecodeError as error:
        warning = f"{name} is not UTF-8 from byte {error.start} on; characters that cannot be read stand as '?'"
    if not _C1_CONTROL.search(data):
        return data.decode("latin-1"), f"{name} is not UTF-8; it was read as ISO 8859-1"
    return data.decode("utf-8", "replace"), warning


def as_utf8(data: bytes, encoding: str | None = None) -> tuple[bytes, str]:
    """Text of a file as UTF-8 without a byte order mark, and the encoding it was in.

    Parameters
    ----------
    data : bytes
    encoding : str, optional
        Where it is declared: a byte order mark counts more. Without it text that is not UTF-8 is UTF-16 if every
        other byte of its beginning is NUL, or else Windows-1252.

    Raises
    ------
    UnreadableUpload
        The file is not text in this encoding, or holds NUL.
    """
    mark, of_mark = next(((bom, name) for bom, name in _BOMS if data.startswith(bom)), (b"", None))
    name = of_mark or encoding or guess_encoding(data)
    name = "utf-8" if name == "utf-8-sig" else name
    try:
        if name == "utf-8":
            data = data[len(mark) :]
            _check_utf8(data)
        else:
            data = data.decode(name).encode()
    except UnicodeDecodeError as error:
        raise UnreadableUpload(
            f"the file is not text in {name}: {error.reason}",
            field="file",
            limit="UTF-8, UTF-16 or Windows-1252, or the declared encoding",
            cure="save the file as UTF-8, or declare its encoding",
        ) from error
    if b"\x00" in data:
        raise UnreadableUpload("the file holds NUL", field="file", limit="text", cure="save the file as UTF-8 text")
    return data, name


def guess_encoding(data: bytes) -> str:
    """Encoding of text by its byte order mark, or by which bytes occur."""
    for bom, name in _BOMS:
        if data.startswith(bom):
            return name
    sample = data[:_SAMPLE_BYTES]
    for name, first in (("utf-16-le", 1), ("utf-16-be", 0)):
        nul, text = sample[first::2], sample[1 - first :: 2]
        if nul and nul.count(0) > 0.9 * len(nul) and not text.count(0):
            return name
    try:
        _check_utf8(data)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _check_utf8(data: bytes) -> None:
    """Decode without keeping the result; raises UnicodeDecodeError."""
    decoder = codecs.getincrementaldecoder("utf-8")()
    for start in range(0, len(data), _DECODED_BYTES):
        decoder.decode(data[start : start + _DECODED_BYTES])
    decoder.decode(b"", final=True)


def clean_text(value: object, length: int = MAX_NAME) -> str | None:
    """A text that can be stored and shown; None where there is none."""
    if not isinstance(value, str | int) or isinstance(value, bool):
        return None
    text = value[:length].strip() if isinstance(value, str) else str(value) if abs(value) < 10**20 else ""
    if not text.isprintable():  # lone surrogates and NUL are not
        text = "".join(c if c.isprintable() else "?" for c in text)
    return text or None


def numbered_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines that are not empty, with their numbers from 0."""
    for number, line in enumerate(text.split("\n")):
        stripped = line.strip(_BLANK)
        if stripped:
            yield number, stripped
