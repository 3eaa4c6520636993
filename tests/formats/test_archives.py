"""ZIP archives with entries that no program writes."""

from __future__ import annotations

import io
import zipfile

import pytest

from app.errors import WaymarkError
from app.formats.format import count_members, read_members
from app.formats.surveys.declaration import ImportDeclaration
from app.formats.surveys.read import read_survey
from app.formats.traces.declaration import TraceLimits
from app.formats.traces.parts import open_parts


def _zip_without_a_name(*others: str) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name in ("x", *others):
            archive.writestr(name, b"<kml/>")
    data = packed.getvalue()
    local, central = data.index(b"PK\x03\x04"), data.index(b"PK\x01\x02")
    shorter = bytearray(data)
    for at in (central + 28, local + 26):  # APPNOTE, sections 4.3.7 and 4.3.12: length of the name
        shorter[at : at + 2] = b"\x00\x00"
        shorter[at + 2] += 1  # the byte of the name becomes extra field
    return bytes(shorter)


def test_an_entry_without_a_name_is_no_file() -> None:
    assert count_members(_zip_without_a_name("a.jpg")) == 1
    assert [member.name for member in read_members(_zip_without_a_name("a.jpg"))] == ["a.jpg"]
    with pytest.raises(WaymarkError, match="empty"):
        count_members(_zip_without_a_name())


@pytest.mark.parametrize("name", ["doc.kml", "a.shp"])
def test_surveys_with_an_entry_without_a_name(name: str) -> None:
    with pytest.raises(WaymarkError):
        read_survey(_zip_without_a_name(name), ImportDeclaration(crs="EPSG:4326"))


def test_recordings_with_an_entry_without_a_name() -> None:
    parts = open_parts({"drive.zip": _zip_without_a_name("a.csv")}, TraceLimits())
    assert [part.name for part in parts] == ["a.csv"]
