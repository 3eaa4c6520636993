"""What makes a PDF a PDF/X-4 (ISO 15930-7:2010): metadata as XMP, and an output intent with an embedded ICC profile.

X-4 asks for dates and ids, and the same drawing must always give the same bytes. So the dates are those of the writer,
and the ids are hashes of the content.
"""

from __future__ import annotations

import hashlib
import re
import uuid
import zlib
from collections.abc import Iterable
from functools import lru_cache
from importlib import resources
from xml.sax.saxutils import escape

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
