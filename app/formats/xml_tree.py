"""XML of uploads: checked for size, depth and document types before a tree is built. No entity is ever expanded."""

from __future__ import annotations

import codecs
import math
import re
import xml.etree.ElementTree as ET
from xml.parsers import expat

from app.errors import UnreadableUpload, UploadTooLarge
from app.formats.text import BOMS

MAX_DEPTH = 100
"""Levels of a document."""
MAX_BYTES = 256 * 2**20
MAX_ELEMENTS = 2_000_000
"""Size of a document that is kept in memory as a tree. A tree of it takes about 1 GB."""
MAX_NUMBER = 1e12
"""Greatest number of a road file; it keeps cubes of polynomials finite. 25 times the equator in millimetres."""


_DECLARATION = re.compile(r"""\s*<\?xml\s[^>]*?\bencoding\s*=\s*["']([\w.:-]{1,40})["'][^>]*\?>""")
_HEAD_BYTES = 1024  # in which the XML declaration stands
_ROOT_BYTES = 4096  # in which the root element stands
_MARKS = (*BOMS, (b"<\0", "utf-16-le"), (b"\0<", "utf-16-be"))
"""First bytes of documents whose encoding they show. Source: XML 1.0, appendix F."""
_LABELS = {"x-sjis": "shift_jis", "windows-31j": "cp932", "windows-874": "cp874"}
"""Python's names of encodings that it does not know by these labels."""
_SUPERSETS = {"ascii": "utf-8", "gb2312": "gb18030", "gbk": "gb18030", "shift_jis": "cp932", "euc_kr": "cp949"}
"""Encodings that contain the declared ones, and that programs mean. Source: WHATWG Encoding, section 4.2."""
_ENCODINGS = re.compile(
    r"utf-8|gb18030|cp\d{3,4}|big5(hkscs)?|euc_jp|iso2022_jp|iso8859-\d+|koi8-[rtu]|mac-\w+|tis-620"
)
"""Encodings of text, by their names in Python; others (such as base64) are no encodings of documents."""


def xml_encoding(data: bytes) -> str:
    """Python's name of a document's encoding: by its first bytes, or as it declares; UTF-8 without either.

    Raises
    ------
    UnreadableUpload
        The declared encoding is not known.
    """
    marked = next((name for mark, name in _MARKS if data.startswith(mark)), None)
    declared = _DECLARATION.match(data[:_HEAD_BYTES].decode("latin-1")) if marked is None else None
    if declared is None:
        return marked or "utf-8"
    try:
        label = declared[1].lower()
        name = codecs.lookup(_LABELS.get(label, label)).name
    except LookupError:
        name = ""
    if name.startswith(("utf-16", "utf-32")):  # one byte a character was just read: texts of .NET that are UTF-8
        return "utf-8"
    name = _SUPERSETS.get(name, name)
    if _ENCODINGS.fullmatch(name) is None:
        raise UnreadableUpload(
            f"the XML declares the encoding {declared[1]!r}, which is not known",
            field="file",
            limit="UTF-8, UTF-16, ISO-8859, Windows, GB, Big5, Shift_JIS, EUC and KOI8 encodings",
            cure="save the file in UTF-8",
        )
    return name


def xml_head(data: bytes) -> bytes:
    """The beginning of a document in UTF-8, to see what it is."""
    head = data[:_ROOT_BYTES]
    try:
        return head.decode(xml_encoding(head), "ignore").lstrip().encode()
    except UnreadableUpload:
        return head.lstrip()


def _in_utf8(data: bytes) -> bytes:
    """A document in UTF-8, without the declaration of another encoding. Expat knows no encodings of several bytes."""
    name = xml_encoding(data)
    head = _DECLARATION.match(data[:_HEAD_BYTES].removeprefix(codecs.BOM_UTF8).decode("latin-1"))
    if name.startswith("utf-8") and (head is None or head[1].lower() == "utf-8"):
        return data
    try:
        text = data.decode(name)
    except UnicodeDecodeError as error:
        raise UnreadableUpload(
            f"the XML is declared to be in {head[1] if head else name}, and byte {error.start + 1} is not",
            field="file",
            limit="text in the encoding that it declares",
            cure="save the file in UTF-8",
        ) from error
    declared = _DECLARATION.match(text)
    return text[declared.end() if declared else 0 :].encode()


def check_xml(data: bytes, *, max_elements: int, cure: str) -> bytes:
    """The document in UTF-8, checked in one pass that builds nothing: depth, number of elements, no document type.

    Returns
    -------
    bytes
        The document in UTF-8.

    Raises
    ------
    UnreadableUpload
        It is no XML, has a document type or an unknown encoding, or is too deep or too large.
    """
    data = _in_utf8(data)
    depth = count = 0

    def refuse(*_: object) -> None:
        raise UnreadableUpload(
            "the file declares a document type", field="file", limit="no DOCTYPE", cure="export it without a DTD"
        )

    def start(_name: str, _attributes: object) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > MAX_DEPTH or count > max_elements:
            raise UnreadableUpload(
                "the XML is nested too deeply or has too many elements",
                field="file",
                limit=f"{MAX_DEPTH} levels, {max_elements} elements",
                cure=cure,
            )

    def end(_name: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate(namespace_separator="}")  # as ElementTree: unbound prefixes are errors
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError) as error:
        message, cure = f"not XML: {error}", "export it again"
        try:
            data.decode("utf-8")
        except UnicodeDecodeError as wrong:
            message = f"not XML: byte {wrong.start + 1} is not UTF-8, and the file declares no other encoding"
            cure = "save the file in UTF-8, or state its encoding in its first line"
        raise UnreadableUpload(message, field="file", limit="XML 1.0", cure=cure) from error
    return data


def parse_xml(data: bytes, root: str) -> ET.Element:
    """Tree of a document, its tags without namespaces.

    Parameters
    ----------
    root : str
        Name of the root element that is expected.

    Raises
    ------
    UnreadableUpload
        It is no such XML, has a document type, or is too deep or too large.
    """
    if len(data) > MAX_BYTES:
        raise UploadTooLarge(
            f"the file has {len(data)} bytes", field="file", limit=f"{MAX_BYTES} bytes", cure="cut the road into parts"
        )
    tree = ET.fromstring(check_xml(data, max_elements=MAX_ELEMENTS, cure="cut the road into parts"))
    for element in tree.iter():
        element.tag = local_name(element.tag)
    if tree.tag != root:
        raise UnreadableUpload(
            f"the file begins with the element {tree.tag[:40]!r}",
            field="file",
            limit=f"an element {root!r}",
            cure="send a file of the declared format",
        )
    return tree


def local_name(tag: str) -> str:
    """Name of an element without its namespace."""
    return tag.rpartition("}")[2]


def finite_number(text: str | None, name: str, place: str) -> float:
    """A number of a road file.

    Parameters
    ----------
    name, place : str
        Which number it is and where, for the error.

    Raises
    ------
    UnreadableUpload
        It is missing, not a number, not finite, or above `MAX_NUMBER`.
    """
    try:
        value = float(text) if text is not None else math.nan
    except ValueError:
        value = math.nan
    if math.isfinite(value) and abs(value) <= MAX_NUMBER:
        return value
    state = "is missing" if text is None else f"is {text.strip()[:40]!r}"
    raise UnreadableUpload(
        f"{place}: {name} {state}",
        field="file",
        limit=f"a number between {-MAX_NUMBER:.0e} and {MAX_NUMBER:.0e}",
        cure="correct the file at this place, or export it again",
    )


def attribute(element: ET.Element, name: str, place: str, default: float | None = None) -> float:
    """A number among the attributes of an element; raises as `finite_number` if it is missing without a default."""
    text = element.get(name)
    return default if text is None and default is not None else finite_number(text, name, place)
