"""PDF 1.4 and PDF/X-4 at true size: the file, its pages and properties, embedded fonts, drawing in millimetres.

Artwork needs spot inks, overprint, outlined text and a hundred plates a second; a drilling sheet needs text that can
be searched. Both need a dozen kinds of PDF object (ISO 32000-1), which are written here once. Numbers in brackets are
its clauses. The same calls always give the same bytes.
"""

from __future__ import annotations

import hashlib
import math
import re
import uuid
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from io import BytesIO
from typing import Any
from xml.sax.saxutils import escape

from fontTools.ttLib import TTFont

# === The typeface of everything that is built: Bitstream Vera, whose licence allows embedding and redistribution.


@dataclass(frozen=True, slots=True, eq=False)
class Typeface:
    """One weight of the typeface."""

    content: bytes  # the TrueType file
    font: Any
    glyphs: Any  # outlines by the names of glyphs
    names: dict[int, str]  # name of the glyph of each character that the typeface has

    @property
    def units_per_em(self) -> int:
        """Font units to the em."""
        return int(self.font["head"].unitsPerEm)

    def advance_units(self, name: str) -> int:
        """Width of a glyph. [font unit]"""
        return int(self.font["hmtx"][name][0])

    def glyph_name(self, character: str, missing: str) -> str:
        """Name of a character's glyph; `missing` if the typeface lacks it."""
        return self.names.get(ord(character), missing)


@lru_cache(maxsize=2)
def load_typeface(*, bold: bool = False) -> Typeface:
    """One weight, read once."""
    content = resources.files("app.encoders").joinpath(f"data/{'VeraBd' if bold else 'Vera'}.ttf").read_bytes()
    font = TTFont(BytesIO(content), lazy=False)
    return Typeface(content, font, font.getGlyphSet(), font.getBestCmap())


# === What makes a PDF a PDF/X-4 (ISO 15930-7:2010): metadata as XMP, and an output intent with an embedded ICC profile.
#
# X-4 asks for dates and ids, and the same drawing must always give the same bytes. So the dates are those of the
# writer, and the ids are hashes of the content.


VERSION = "PDF/X-4"
WRITTEN = "2026-11-25T00:00:00Z"
"""When the writer of artwork changed last. Every file names it as the time of its creation and its last change."""
PDF_DATE = f"D:{re.sub('[^0-9]', '', WRITTEN)}Z"
CONDITION = "FOGRA39"
"""Identifier of the printing condition in the ICC's registry: offset on coated paper, ISO 12647-2:2004. Plates are
printed in spot inks; the condition defines the colours of their process-colour substitutes on a proof."""
_CONDITION_TEXT = "Coated FOGRA39 (ISO 12647-2:2004)"
_REGISTRY = "http://www.color.org"
_NOT_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def xml_text(text: str) -> str:
    """A text without the characters that XML cannot have; the document's properties must agree with the XMP."""
    return _NOT_XML.sub("?", text)


def document_id(objects: Iterable[bytes]) -> uuid.UUID:
    """The id of a document with some content."""
    digest = hashlib.sha256()
    for body in objects:
        digest.update(body)
    return uuid.UUID(bytes=digest.digest()[:16], version=4)


@lru_cache(maxsize=1)
def profile_stream() -> bytes:
    """The ICC profile of the printing condition as a stream (ISO 32000-1, 8.6.5.5), deflated once."""
    packed = zlib.compress(resources.files("app.encoders").joinpath("data/fogra39-coated.icc").read_bytes(), 9)
    return b"<< /N 4 /Filter /FlateDecode /Length %d >>\nstream\n%b\nendstream" % (len(packed), packed)


def output_intent(profile: int) -> bytes:
    """The output intent (14.11.5), with the number of the profile's object. X-4 embeds it; X-4p would refer to it."""
    return (
        f"<< /Type /OutputIntent /S /GTS_PDFX /OutputConditionIdentifier ({CONDITION}) /RegistryName ({_REGISTRY}) "
        f"/OutputCondition ({_CONDITION_TEXT.replace('(', chr(92) + '(').replace(')', chr(92) + ')')}) "
        f"/DestOutputProfile {profile} 0 R >>"
    ).encode("ascii")


def metadata_stream(title: str, tool: str, document: uuid.UUID) -> bytes:
    """The XMP packet (14.3.2), which is not compressed: tools find it without reading the PDF."""
    packet = _PACKET.format(
        title=escape(title), tool=escape(tool), version=VERSION, date=WRITTEN, document=f"uuid:{document}"
    ).encode()
    return b"<< /Type /Metadata /Subtype /XML /Length %d >>\nstream\n%b\nendstream" % (len(packet), packet)


_PACKET = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:dc="http://purl.org/dc/elements/1.1/" xmlns:xmp="http://ns.adobe.com/xap/1.0/"
 xmlns:xmpMM="http://ns.adobe.com/xap/1.0/mm/" xmlns:pdf="http://ns.adobe.com/pdf/1.3/"
 xmlns:pdfxid="http://www.npes.org/pdfx/ns/id/">
<pdfxid:GTS_PDFXVersion>{version}</pdfxid:GTS_PDFXVersion>
<dc:format>application/pdf</dc:format>
<dc:title><rdf:Alt><rdf:li xml:lang="x-default">{title}</rdf:li></rdf:Alt></dc:title>
<xmp:CreatorTool>{tool}</xmp:CreatorTool>
<xmp:CreateDate>{date}</xmp:CreateDate>
<xmp:ModifyDate>{date}</xmp:ModifyDate>
<xmp:MetadataDate>{date}</xmp:MetadataDate>
<xmpMM:DocumentID>{document}</xmpMM:DocumentID>
<xmpMM:VersionID>1</xmpMM:VersionID>
<xmpMM:RenditionClass>default</xmpMM:RenditionClass>
<pdf:Producer>{tool}</pdf:Producer>
<pdf:Trapped>False</pdf:Trapped>
</rdf:Description>
</rdf:RDF>
</x:xmpmeta>
<?xpacket end="r"?>"""


# === PDF 1.4 and PDF/X-4 at true size.


POINTS_PER_MM = 72.0 / 25.4
"""A point is 1/72 inch, an inch is 25.4 mm. [point/mm]"""
Box = tuple[float, float, float, float]
"""Left, bottom, right, top. [mm]"""
_CATALOG, _PAGES, _INFO = 1, 2, 3
_COMPRESSION = 6
_TOOL = "Waymark"
_CIRCLE = 0.5522847498
"""Distance of the control points of a quarter circle of radius 1 from its ends: 4 / 3 (sqrt(2) - 1)."""


class PdfFile:
    """Objects by number, and the pages among them.

    Parameters
    ----------
    compress : bool
        Deflate the streams.
    print_ready : bool
        Make it a PDF/X-4. What is painted must then be in process or spot inks, without transparency.
    """

    def __init__(self, title: str, *, compress: bool = True, print_ready: bool = False) -> None:
        self.compress = compress
        self._title = xml_text(title)
        self._print_ready = print_ready
        dates = f" /CreationDate ({PDF_DATE}) /ModDate ({PDF_DATE})" if print_ready else ""
        names = f"/Creator ({_TOOL}) /Producer ({_TOOL})"
        properties = f"<< /Title {text_string(self._title)} {names}{dates} /Trapped /False >>"
        self._objects: list[bytes] = [b"", b"", properties.encode()]
        self._pages: list[int] = []

    @property
    def next_number(self) -> int:
        """Number of the object that is added next."""
        return len(self._objects) + 1

    def add(self, body: bytes) -> int:
        """Add an object; returns its number."""
        self._objects.append(body)
        return len(self._objects)

    def add_stream(self, content: bytes, entries: str = "") -> int:
        """Add a stream (7.3.8), with further entries of its dictionary; returns its number."""
        packing = "/Filter /FlateDecode " if self.compress else ""
        if self.compress:
            content = zlib.compress(content, _COMPRESSION)
        head = f"<< {entries}{packing}/Length {len(content)} >>\nstream\n".encode()
        return self.add(head + content + b"\nendstream")

    def add_jpeg(self, content: bytes, width_px: int, height_px: int) -> int:
        """Add a picture in RGB (8.9.5) as the JPEG that it is; returns its number."""
        entries = f"/Type /XObject /Subtype /Image /Width {width_px} /Height {height_px} /ColorSpace /DeviceRGB "
        head = f"<< {entries}/BitsPerComponent 8 /Filter /DCTDecode /Length {len(content)} >>\nstream\n".encode()
        return self.add(head + content + b"\nendstream")

    def add_page(self, boxes: Mapping[str, Box], resources: int, content: bytes) -> None:
        """Add a page (7.7.3.3) with its boxes (14.11.2), the number of its resources and its operators."""
        rows = " ".join(f"/{name} [{' '.join(f'{v * POINTS_PER_MM:.4f}' for v in box)}]" for name, box in boxes.items())
        page = f"<< /Type /Page /Parent {_PAGES} 0 R {rows} /Resources {resources} 0 R"
        self._pages.append(self.add(f"{page} /Contents {self.next_number + 1} 0 R >>".encode()))
        self.add_stream(content)

    def to_bytes(self) -> bytes:
        """The file: header, objects, cross-reference table and trailer (7.5)."""
        kids = " ".join(f"{number} 0 R" for number in self._pages)
        pages = f"<< /Type /Pages /Count {len(self._pages)} /Kids [{kids}] >>".encode()
        objects = [b"", pages, *self._objects[2:]]
        version, extra, file_id = b"1.4", "", ""
        if self._print_ready:
            document = document_id(objects)
            profile = len(objects) + 1
            objects += [
                profile_stream(),
                output_intent(profile),
                metadata_stream(self._title, _TOOL, document),
            ]
            version, extra = b"1.6", f" /OutputIntents [{profile + 1} 0 R] /Metadata {profile + 2} 0 R"
            file_id = f" /ID [<{document.hex}> <{document.hex}>]"
        objects[_CATALOG - 1] = f"<< /Type /Catalog /Pages {_PAGES} 0 R{extra} >>".encode()
        chunks = [b"%PDF-" + version + b"\n%\xe2\xe3\xcf\xd3\n"]
        position, offsets = len(chunks[0]), []
        for number, body in enumerate(objects, start=1):
            chunk = b"%d 0 obj\n%b\nendobj\n" % (number, body)
            offsets.append(position)
            position += len(chunk)
            chunks.append(chunk)
        chunks.append(b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1))
        chunks += [b"%010d 00000 n \n" % offset for offset in offsets]
        trailer = b"trailer\n<< /Size %d /Root %d 0 R /Info %d 0 R%b >>\nstartxref\n%d\n%%%%EOF\n"
        chunks.append(trailer % (len(objects) + 1, _CATALOG, _INFO, file_id.encode(), position))
        return b"".join(chunks)


def text_string(text: str) -> str:
    """A text string of the document's properties, in UTF-16 with its mark (7.9.2.2)."""
    return f"<feff{text.encode('utf-16-be').hex()}>"


# --- text ---------------------------------------------------------------------------------------------------------


class EmbeddedFont:
    """One weight of the typeface, embedded with the glyphs that a file uses; its text can be searched and copied."""

    def __init__(self, *, bold: bool = False) -> None:
        self._face = load_typeface(bold=bold)
        self._name = "WMVERA+BitstreamVeraSans-" + ("Bold" if bold else "Roman")
        self._used: dict[int, tuple[str, str]] = {}
        self._codes: dict[str, str] = {}
        self._widths: dict[str, int] = {}
        self._mm_per_unit = 1 / self._face.units_per_em / POINTS_PER_MM

    def encode(self, text: str) -> str:
        """A text as the operand of Tj: two bytes a glyph; characters that the typeface lacks are question marks."""
        return f"<{''.join(self._codes.get(character) or self._encode(character) for character in text)}>"

    def width_mm(self, text: str, points: float) -> float:
        """Width of a text. [mm]"""
        widths = self._widths
        for character in set(text).difference(widths):
            widths[character] = self._face.advance_units(self._face.glyph_name(character, "question"))
        return sum(map(widths.__getitem__, text)) * points * self._mm_per_unit

    def _encode(self, character: str) -> str:
        name = self._face.glyph_name(character, "question")
        glyph = self._face.font.getGlyphID(name)
        self._used.setdefault(glyph, (name, character if ord(character) in self._face.names else "?"))
        return self._codes.setdefault(character, f"{glyph:04x}")

    def add_to(self, file: PdfFile) -> int:
        """Add the composite font (9.7) of all texts encoded so far; returns its number."""
        used = sorted(self._used.items())
        per_mille = 1000 / self._face.units_per_em
        program = self._subset()
        font_file = file.add_stream(program, f"/Length1 {len(program)} ")
        head, line = self._face.font["head"], self._face.font["hhea"]
        box = " ".join(f"{v * per_mille:.0f}" for v in (head.xMin, head.yMin, head.xMax, head.yMax))
        descriptor = file.add(
            f"<< /Type /FontDescriptor /FontName /{self._name} /Flags 4 /FontBBox [{box}] /ItalicAngle 0 "
            f"/Ascent {line.ascent * per_mille:.0f} /Descent {line.descent * per_mille:.0f} /CapHeight 729 /StemV 80 "
            f"/FontFile2 {font_file} 0 R >>".encode()
        )
        widths = " ".join(f"{g} [{self._face.advance_units(name) * per_mille:.0f}]" for g, (name, _c) in used)
        system = "<< /Registry (Adobe) /Ordering (Identity) /Supplement 0 >>"
        descendant = file.add(
            f"<< /Type /Font /Subtype /CIDFontType2 /BaseFont /{self._name} /CIDSystemInfo {system} "
            f"/FontDescriptor {descriptor} 0 R /W [{widths}] /CIDToGIDMap /Identity >>".encode()
        )
        characters = file.add_stream(_to_unicode({glyph: character for glyph, (_name, character) in used}))
        return file.add(
            f"<< /Type /Font /Subtype /Type0 /BaseFont /{self._name} /Encoding /Identity-H "
            f"/DescendantFonts [{descendant} 0 R] /ToUnicode {characters} 0 R >>".encode()
        )

    def _subset(self) -> bytes:
        from fontTools import subset  # 0.1 s that only a drilling sheet needs

        font = TTFont(BytesIO(self._face.content), recalcTimestamp=False)
        options = subset.Options(hinting=False, retain_gids=True, notdef_outline=True, layout_features=[])
        options.drop_tables += ["cmap", "name", "OS/2", "kern", "GSUB", "GPOS", "GDEF"]
        subsetter = subset.Subsetter(options)
        subsetter.populate(gids=sorted(self._used))
        subsetter.subset(font)
        stream = BytesIO()
        font.save(stream)
        return stream.getvalue()


def _to_unicode(characters: Mapping[int, str]) -> bytes:
    """The CMap from glyphs to characters (9.10.3)."""
    pairs = [f"<{glyph:04x}> <{character.encode('utf-16-be').hex()}>" for glyph, character in characters.items()]
    blocks = [pairs[start : start + 100] for start in range(0, len(pairs), 100)]  # no more stand in one block
    mapped = "\n".join(f"{len(block)} beginbfchar\n" + "\n".join(block) + "\nendbfchar" for block in blocks)
    return (
        "/CIDInit /ProcSet findresource begin 12 dict begin begincmap\n"
        "/CIDSystemInfo << /Registry (Adobe) /Ordering (UCS) /Supplement 0 >> def\n"
        "/CMapName /Adobe-Identity-UCS def /CMapType 2 def\n"
        f"1 begincodespacerange <0000> <ffff> endcodespacerange\n{mapped}\n"
        "endcmap CMapName currentdict /CMap defineresource pop end end\n"
    ).encode("ascii")


# --- drawing ------------------------------------------------------------------------------------------------------


class Canvas:
    """What is painted on one page, in millimetres from its lower left corner. Colours are written as ``#rrggbb``."""

    def __init__(self, fonts: Mapping[str, EmbeddedFont]) -> None:
        self._fonts = fonts
        self._pieces: list[str] = []

    def content(self) -> bytes:
        """The page's operators."""
        return "\n".join(self._pieces).encode("ascii")

    def text(
        self, x: float, y: float, text: str, *, font: str, points: float, colour: str, anchor: str = "start",
        angle_deg: float = 0.0,
    ) -> None:  # fmt: skip
        """A line of text, anchored at its start, middle or end; the angle is counter-clockwise."""
        share = {"start": 0.0, "middle": 0.5, "end": 1.0}[anchor]
        back = share * self._fonts[font].width_mm(text, points)
        if angle_deg:
            cos, sin = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
            turn = f"{cos:.6f} {sin:.6f} {-sin:.6f} {cos:.6f}"
            place = f"{turn} {_points(x - back * cos)} {_points(y - back * sin)} Tm"
        else:
            place = f"{_points(x - back)} {_points(y)} Td"
        shown = self._fonts[font].encode(text)
        self._pieces.append(f"BT /{font} {points:.3f} Tf {_colour(colour)} rg {place} {shown} Tj ET")

    def lines(
        self, points_mm: Iterable[tuple[float, float]], *, width_mm: float, colour: str, dash: Sequence[int] = ()
    ) -> None:
        """An open line through points; the dash pattern is in points."""
        path = " ".join(f"{_points(x)} {_points(y)} {'l' if i else 'm'}" for i, (x, y) in enumerate(points_mm))
        pattern = f"[{' '.join(map(str, dash))}] 0 d "
        self._pieces.append(f"{pattern}{_colour(colour)} RG {_points(width_mm)} w {path} S")

    def polygon(
        self, points_mm: Iterable[tuple[float, float]], *, fill: str | None, outline: str | None, width_mm: float = 0.1
    ) -> None:
        """A closed area, filled, outlined, or both."""
        path = " ".join(f"{_points(x)} {_points(y)} {'l' if i else 'm'}" for i, (x, y) in enumerate(points_mm))
        filled = f"{_colour(fill)} rg " if fill else ""
        lined = f"[] 0 d {_colour(outline)} RG {_points(width_mm)} w " if outline else ""
        self._pieces.append(f"{filled}{lined}{path} {'b' if fill and outline else 'f' if fill else 's'}")

    @contextmanager
    def clipped(self, x: float, y: float, width: float, height: float) -> Iterator[None]:
        """Within it, nothing is painted outside of a rectangle."""
        sides = " ".join(map(_points, (x, y, width, height)))
        self._pieces.append(f"q {sides} re W n")
        yield
        self._pieces.append("Q")

    def box(self, x: float, y: float, width: float, height: float, *, fill: str) -> None:
        """A filled rectangle."""
        sides = " ".join(map(_points, (x, y, width, height)))
        self._pieces.append(f"{_colour(fill)} rg {sides} re f")

    def picture(self, name: str, x: float, y: float, width: float, height: float) -> None:
        """A picture of the page's resources, in a rectangle."""
        self._pieces.append(f"q {_points(width)} 0 0 {_points(height)} {_points(x)} {_points(y)} cm /{name} Do Q")

    def circle(self, x: float, y: float, radius: float, *, fill: str, outline: str, width_mm: float) -> None:
        """A filled circle with an outline."""
        reach = _CIRCLE * radius
        quarters = (
            (x + radius, y + reach, x + reach, y + radius, x, y + radius),
            (x - reach, y + radius, x - radius, y + reach, x - radius, y),
            (x - radius, y - reach, x - reach, y - radius, x, y - radius),
            (x + reach, y - radius, x + radius, y - reach, x + radius, y),
        )
        curves = " ".join(" ".join(map(_points, quarter)) + " c" for quarter in quarters)
        colours = f"[] 0 d {_colour(fill)} rg {_colour(outline)} RG {_points(width_mm)} w"
        self._pieces.append(f"{colours} {_points(x + radius)} {_points(y)} m {curves} b")


def _points(value_mm: float) -> str:
    return f"{value_mm * POINTS_PER_MM:.3f}"


def _colour(colour: str) -> str:
    red, green, blue = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return f"{red:.3g} {green:.3g} {blue:.3g}"
