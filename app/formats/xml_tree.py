"""XML of uploads: checked for size, depth and document types before a tree is built. No entity is ever expanded."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from xml.parsers import expat

from app.errors import UnreadableUpload, UploadTooLarge

MAX_DEPTH = 100
"""Levels of a document."""
MAX_BYTES = 256 * 2**20
MAX_ELEMENTS = 2_000_000
"""Size of a document that is kept in memory as a tree. A tree of it takes about 1 GB."""
MAX_NUMBER = 1e9
"""Greatest number of a road file; it keeps cubes of polynomials finite. 25 times the equator."""


def check_xml(data: bytes, *, max_elements: int, cure: str) -> None:
    """Check a document in one pass that builds nothing: depth, number of elements, no document type.

    Raises
    ------
    UnreadableUpload
        It is no XML, has a document type, or is too deep or too large.
    """
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
    except (expat.ExpatError, ValueError, LookupError) as error:  # the last two: unknown encodings
        raise UnreadableUpload(f"not XML: {error}", field="file", limit="XML 1.0", cure="export it again") from error


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
    check_xml(data, max_elements=MAX_ELEMENTS, cure="cut the road into parts")
    tree = ET.fromstring(data)
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
