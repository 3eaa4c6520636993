"""Artwork is PDF/X-4: every structural requirement of ISO 15930-7 that applies to it, read by pikepdf and LittleCMS."""

from __future__ import annotations

import io
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lxml.etree
import pikepdf
import pytest
from PIL import Image, ImageCms

from app.encoders.pdf import PdfFile
from app.encoders.plate import ArtworkOptions, PlateOrder, encode_plate, encode_sheets, write_pdf
from tests.http import WITHIN_S

FORBIDDEN = {
    "/JS", "/JavaScript", "/OpenAction", "/AA", "/Annots", "/AcroForm", "/XFA", "/Encrypt", "/TR", "/TR2", "/HTP",
    "/HT", "/OPI", "/Alternates", "/SMask", "/Group", "/BM", "/ca", "/CA", "/PS", "/PieceInfo", "/EmbeddedFiles",
    "/Ref", "/Font", "/Perms", "/PresSteps", "/OCProperties",
}  # fmt: skip
"""Keys that X-4 forbids, or that this artwork has no use for: transparency, transfer curves, actions, live text."""
OPERATORS = {
    "q", "Q", "cm", "cs", "CS", "scn", "SCN", "gs", "w", "m", "l", "c", "v", "y", "h", "re", "f", "f*", "s", "S", "Do",
    "n",
}  # fmt: skip
NAMESPACES = {
    "rdf": "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
    "dc": "http://purl.org/dc/elements/1.1/",
    "xmp": "http://ns.adobe.com/xap/1.0/",
    "xmpMM": "http://ns.adobe.com/xap/1.0/mm/",
    "pdf": "http://ns.adobe.com/pdf/1.3/",
    "pdfxid": "http://www.npes.org/pdfx/ns/id/",
}
KINDS = ["one", "under the face", "sheets", "not compressed"]


@pytest.fixture(params=KINDS)
def content(request: pytest.FixtureRequest, make_order: Callable[..., PlateOrder]) -> bytes:
    order = make_order(plate_id="路标 & <é>")
    match request.param:
        case "one":
            return write_pdf(encode_plate(order))
        case "under the face":
            return write_pdf(encode_plate(order, ArtworkOptions(heaters=True, leds=True)))
        case "sheets":
            return write_pdf(encode_sheets([order] * 4, width_mm=900, height_mm=900))
    return write_pdf(encode_plate(order), compress=False)


@pytest.fixture
def document(content: bytes) -> Iterator[pikepdf.Pdf]:
    with pikepdf.open(io.BytesIO(content)) as opened:
        yield opened


def _xmp(document: pikepdf.Pdf) -> Any:
    packet = document.Root.Metadata.read_raw_bytes()
    assert "/Filter" not in document.Root.Metadata
    assert packet.startswith('<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>'.encode())
    assert packet.endswith(b'<?xpacket end="r"?>')
    return lxml.etree.fromstring(packet)


def test_the_file(content: bytes, document: pikepdf.Pdf) -> None:
    assert content.startswith(b"%PDF-1.6\n")
    assert not document.is_encrypted
    assert not document.check_pdf_syntax()
    first, second = document.trailer.ID
    assert len(bytes(first)) == len(bytes(second)) == 16
    assert b"/LZWDecode" not in content
    assert b"/ObjStm" not in content


def test_the_metadata_name_the_standard_and_agree_with_the_properties(document: pikepdf.Pdf) -> None:
    xmp = _xmp(document)

    def text(path: str) -> str:
        (found,) = xmp.xpath(f"//{path}", namespaces=NAMESPACES)
        return str(found.text)

    assert text("pdfxid:GTS_PDFXVersion") == "PDF/X-4"
    assert text("xmpMM:RenditionClass") == "default"
    assert text("xmpMM:VersionID") == "1"
    assert re.fullmatch(r"uuid:[0-9a-f-]{36}", text("xmpMM:DocumentID"))
    assert text("xmp:MetadataDate") >= text("xmp:ModifyDate") >= text("xmp:CreateDate")
    info = document.docinfo
    assert text("dc:title/rdf:Alt/rdf:li") == str(info["/Title"])
    assert str(info["/Title"]).startswith(("路标 & <é>", "sheet 1"))
    assert text("xmp:CreatorTool") == str(info["/Creator"])
    assert text("pdf:Producer") == str(info["/Producer"])
    assert f"/{text('pdf:Trapped')}" == str(info["/Trapped"]) == "/False"
    for entry, name in (("/CreationDate", "xmp:CreateDate"), ("/ModDate", "xmp:ModifyDate")):
        assert str(info[entry]) == f"D:{re.sub('[^0-9]', '', text(name))}Z"


def test_the_output_intent_has_the_profile_of_a_printer(document: pikepdf.Pdf) -> None:
    (intent,) = document.Root.OutputIntents
    assert intent.S == "/GTS_PDFX"
    assert str(intent.OutputConditionIdentifier) == "FOGRA39"
    assert str(intent.RegistryName) == "http://www.color.org"
    assert "/DestOutputProfileRef" not in intent  # that would be X-4p
    assert intent.DestOutputProfile.N == 4
    icc = intent.DestOutputProfile.read_bytes()
    assert (icc[12:16], icc[16:20], icc[36:40]) == (b"prtr", b"CMYK", b"acsp")
    assert int.from_bytes(icc[:4], "big") == len(icc)
    count = int.from_bytes(icc[128:132], "big")
    tags = {icc[132 + 12 * k : 136 + 12 * k] for k in range(count)}
    assert {b"A2B0", b"A2B1", b"A2B2", b"B2A0", b"B2A1", b"B2A2", b"gamt", b"wtpt", b"desc", b"cprt"} <= tags


# Solid inks on coated paper in Fogra's characterization data FOGRA39L; paper and single inks as in ISO 12647-2:2004.
# From CMYK in per cent to L*, a*, b*.
SOLIDS = {
    (0, 0, 0, 0): (95, 0, -2), (100, 0, 0, 0): (55, -37, -50), (0, 100, 0, 0): (48, 74, -3),
    (0, 0, 100, 0): (89, -5, 93), (0, 0, 0, 100): (16, 0, 0), (0, 100, 100, 0): (47, 68, 48),
    (100, 0, 100, 0): (50, -65, 27), (100, 100, 0, 0): (24, 22, -46),
}  # fmt: skip


@pytest.mark.parametrize("inks", SOLIDS)
def test_the_profile_gives_the_colours_of_the_standard(
    make_order: Callable[..., PlateOrder], inks: tuple[int, ...]
) -> None:
    with pikepdf.open(io.BytesIO(write_pdf(encode_plate(make_order())))) as document:
        icc = document.Root.OutputIntents[0].DestOutputProfile.read_bytes()
    printer = ImageCms.ImageCmsProfile(io.BytesIO(icc))
    lab = ImageCms.createProfile("LAB", 5000)
    transform = ImageCms.buildTransform(
        printer, lab, "CMYK", "LAB", renderingIntent=ImageCms.Intent.ABSOLUTE_COLORIMETRIC
    )
    picture = Image.new("CMYK", (1, 1), tuple(round(share * 2.55) for share in inks))
    converted = ImageCms.applyTransform(picture, transform)
    assert converted is not None
    lightness, a, b = converted.tobytes()
    found = lightness / 2.55, (a ^ 128) - 128, (b ^ 128) - 128
    assert sum((x - y) ** 2 for x, y in zip(found, SOLIDS[inks], strict=True)) ** 0.5 < 2.5


def test_boxes_lie_within_each_other(document: pikepdf.Pdf) -> None:
    for page in document.pages:
        assert "/ArtBox" not in page
        media, bleed, trim = ([float(value) for value in page[f"/{name}Box"]] for name in ("Media", "Bleed", "Trim"))
        for inner, outer in ((trim, bleed), (bleed, media)):
            assert all(outer[k] <= inner[k] + 1e-6 for k in (0, 1))
            assert all(outer[k] >= inner[k] - 1e-6 for k in (2, 3))


def _dictionaries(document: pikepdf.Pdf) -> Iterator[Any]:
    def within(value: Any, depth: int) -> Iterator[Any]:
        if isinstance(value, (pikepdf.Dictionary, pikepdf.Stream)) and depth < 8:
            yield value
            for inner in value.values():
                yield from within(inner, depth + 1)
        elif isinstance(value, pikepdf.Array) and depth < 8:
            for inner in value:
                yield from within(inner, depth + 1)

    for found in document.objects:
        yield from within(found, 6)


def test_there_is_nothing_that_is_forbidden(document: pikepdf.Pdf) -> None:
    seen = 0
    for found in _dictionaries(document):
        seen += 1
        assert not FORBIDDEN & set(found.keys()), dict(found)
        if found.get("/Type") == "/XObject":
            assert found.Subtype == "/Form"
        if found.get("/Type") == "/ExtGState":
            assert set(found.keys()) == {"/Type", "/OP", "/OPM"}
    assert seen > 10


def test_all_inks_are_spot_inks_with_one_definition_each(document: pikepdf.Pdf) -> None:
    definitions: dict[str, set[bytes]] = {}
    for page in document.pages:
        for space in page.Resources.ColorSpace.values():
            kind, name, alternate, tint = space
            assert (kind, alternate) == ("/Separation", "/DeviceCMYK")  # the output intent is CMYK
            definitions.setdefault(str(name), set()).add(tint.unparse(resolved=True))
        names = {str(name) for name in page.Resources.ColorSpace}
        for operands, operator in pikepdf.parse_content_stream(page):
            assert str(operator) in OPERATORS
            if str(operator) in ("cs", "CS"):
                assert str(operands[0]) in names
    assert all(len(found) == 1 for found in definitions.values())


def test_the_same_drawing_gives_the_same_ids_and_another_gives_others(make_order: Callable[..., PlateOrder]) -> None:
    contents = [write_pdf(encode_plate(make_order(plate_id=name))) for name in ("A", "A", "B")]
    assert contents[0] == contents[1]
    ids = [bytes(pikepdf.open(io.BytesIO(content)).trailer.ID[0]) for content in contents]
    assert ids[0] == ids[1] != ids[2]


def test_a_title_that_xml_cannot_have(make_order: Callable[..., PlateOrder]) -> None:
    for print_ready in (True, False):
        file = PdfFile("a\x0bb\ufffe", print_ready=print_ready)
        content = file.to_bytes()
        assert file.to_bytes() == content
        with pikepdf.open(io.BytesIO(content)) as document:
            assert str(document.docinfo["/Title"]) == "a?b?"
            assert ("/OutputIntents" in document.Root) is print_ready
            if print_ready:
                _xmp(document)


def test_ghostscript_renders_through_the_output_intent(
    content: bytes, require_tool: Callable[..., str], tmp_path: Path
) -> None:
    (tmp_path / "plate.pdf").write_bytes(content)
    command = [require_tool("gs"), "-q", "-dSAFER", "-dBATCH", "-dNOPAUSE", "-dPDFSTOPONERROR", "-dUsePDFX3Profile"]
    run = subprocess.run(
        [*command, "-sDEVICE=tiff32nc", "-r36", "-sOutputFile=page%d.tif", "plate.pdf"],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=WITHIN_S,
    )  # fmt: skip
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")
    assert list(tmp_path.glob("page*.tif"))
