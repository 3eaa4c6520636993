"""Colours of a plate as data: what the fabricator buys, the inspector measures and the files show.

Sources: ASTM D4956 (retroreflective sheeting) and its daytime chromaticity limits as printed in 23 CFR 655, subpart F,
appendix, table 1; ASTM D6628 (colour of retroreflective pavement marking); RAL Classic "traffic" colours.
"""

from __future__ import annotations

from dataclasses import dataclass

from app.encoders.plate.drawing import Layer

Chromaticity = tuple[tuple[float, float], ...]

_WHITE: Chromaticity = ((0.303, 0.300), (0.368, 0.366), (0.340, 0.393), (0.274, 0.329))
_RED: Chromaticity = ((0.648, 0.351), (0.735, 0.265), (0.629, 0.281), (0.565, 0.346))
_GREEN: Chromaticity = ((0.026, 0.399), (0.166, 0.364), (0.286, 0.446), (0.207, 0.771))


@dataclass(frozen=True, slots=True)
class ColourSpec:
    """What one area of the plate must look like.

    Attributes
    ----------
    layer : Layer
    area : str
        Part of the plate, in words.
    ral : str
        Nearest RAL Classic colour.
    sheeting : str
        ASTM D4956 colour, or why there is none.
    marking : str
        ASTM D6628 colour, or why there is none.
    chromaticity_xy : tuple of (x, y)
        Corners of the permitted daytime region, CIE 1931, illuminant D65, 45/0; empty where none is specified.
    """

    layer: Layer
    area: str
    ral: str
    sheeting: str
    marking: str
    chromaticity_xy: Chromaticity = ()


COLOURS = (
    ColourSpec(Layer.BASE, "base and gaps", "RAL 7035 light grey", "none: matt, not retroreflective", "none"),
    ColourSpec(Layer.CODE_LIGHT, "light units", "RAL 9016 traffic white", "D4956 white", "D6628 white", _WHITE),
    ColourSpec(Layer.CODE_DARK, "dark units", "RAL 9017 traffic black", "none: matt, not retroreflective", "none"),
    ColourSpec(Layer.MARK_RED, "triangle", "RAL 3020 traffic red", "D4956 red", "none: a sheeting colour", _RED),
    ColourSpec(Layer.MARK_GREEN, "squares", "RAL 6024 traffic green", "D4956 green", "none: a sheeting colour", _GREEN),
)


@dataclass(frozen=True, slots=True)
class Ink:
    """How the files show a layer: sRGB on screens, CMYK as the alternate of the spot ink, an AutoCAD colour index."""

    rgb: tuple[int, int, int]
    cmyk: tuple[float, float, float, float]
    aci: int

    @property
    def hex(self) -> str:
        """sRGB as #rrggbb."""
        return "#{:02x}{:02x}{:02x}".format(*self.rgb)


_BASE = Ink((203, 208, 204), (0.03, 0.0, 0.02, 0.18), 9)
INKS: dict[Layer, Ink] = {
    Layer.BLEED: _BASE,
    Layer.BASE: _BASE,
    Layer.CODE_LIGHT: Ink((241, 240, 234), (0.0, 0.0, 0.02, 0.04), 254),
    Layer.CODE_DARK: Ink((30, 30, 32), (0.1, 0.05, 0.0, 0.95), 250),
    Layer.MARK_RED: Ink((187, 30, 16), (0.0, 0.95, 0.95, 0.15), 1),
    Layer.MARK_GREEN: Ink((0, 125, 75), (0.95, 0.0, 0.75, 0.35), 3),
    Layer.HEATER: Ink((214, 110, 0), (0.0, 0.55, 1.0, 0.1), 30),
    Layer.LED: Ink((0, 130, 200), (0.9, 0.3, 0.0, 0.0), 5),
    Layer.ENGRAVE: Ink((70, 40, 120), (0.7, 0.9, 0.0, 0.2), 6),
    Layer.NOTE: Ink((60, 60, 60), (0.0, 0.0, 0.0, 0.8), 8),
    Layer.CROP: Ink((0, 0, 0), (1.0, 1.0, 1.0, 1.0), 7),
    Layer.CUT: Ink((230, 0, 126), (0.0, 1.0, 0.0, 0.0), 2),
}
