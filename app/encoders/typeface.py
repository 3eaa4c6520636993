"""The typeface of everything that is built: Bitstream Vera, read from the installed reportlab.

Its licence allows embedding and redistribution.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from io import BytesIO
from typing import Any

from fontTools.ttLib import TTFont


@dataclass(frozen=True, slots=True, eq=False)
class Typeface:
    """One weight of the typeface.

    Attributes
    ----------
    content : bytes
        The TrueType file.
    font : fontTools.ttLib.TTFont
    glyphs : mapping of str to glyph
        Outlines by the names of glyphs.
    names : dict of int to str
        Name of the glyph of each character that the typeface has.
    """

    content: bytes
    font: Any
    glyphs: Any
    names: dict[int, str]

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
    content = (resources.files("reportlab") / "fonts" / ("VeraBd.ttf" if bold else "Vera.ttf")).read_bytes()
    font = TTFont(BytesIO(content), lazy=False)
    return Typeface(content, font, font.getGlyphSet(), font.getBestCmap())
