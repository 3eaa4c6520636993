"""Drawing -> DXF in millimetres, for routers, plotters and CAD."""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from app.encoders.plate.colours import INKS
from app.encoders.plate.drawing import Boxes, Drawing, FloatArray, Layer, Modules, Part, Shape, Stroke, Text
from app.encoders.plate.lettering import contours_mm

if TYPE_CHECKING:
    from ezdxf.layouts.layout import Modelspace

LAYERS = (
    Layer.CUT,
    Layer.CODE_DARK,
    Layer.CODE_LIGHT,
    Layer.MARK_RED,
    Layer.MARK_GREEN,
    Layer.ENGRAVE,
    Layer.HEATER,
    Layer.LED,
    Layer.NOTE,
)
"""No BASE or BLEED, which are ink only and would be cut in vain; the plate's outline is CUT."""

_MILLIMETRES = 4
_ALIGNMENTS = {
    "start": "LEFT",
    "middle": "CENTER",
    "end": "RIGHT",
}
_DATES = re.compile(r"(\$TD(?:CREATE|UPDATE)\n 40\n)[^\n]*")
_GUIDS = re.compile(r"(\$(?:FINGERPRINT|VERSION)GUID\n  2\n)[^\n]*")
_STAMPS = re.compile(r"^(\d+\.\d+[^ \n]*) @ \d{4}-\d\d-\d\dT[^\n]*$", re.MULTILINE)


def write_dxf(drawing: Drawing) -> bytes:
    """Write a drawing as DXF R2010.

    Parameters
    ----------
    drawing : Drawing

    Returns
    -------
    bytes
        Model space in millimetres (``$INSUNITS`` = 4). Areas are closed LWPOLYLINE, those of a layer that touch are
        merged; engraved text is outlined, notes are TEXT. The same drawing always gives the same bytes.
    """
    from ezdxf.document import Drawing as DxfDocument

    document = DxfDocument.new("R2010")
    document.header["$INSUNITS"] = _MILLIMETRES
    document.header["$MEASUREMENT"] = 1
    document.header["$LUNITS"] = 2
    for layer in LAYERS:
        document.layers.add(str(layer), color=INKS[layer].aci)
    space = document.modelspace()
    by_layer = drawing.by_layer()
    by_layer[Layer.NOTE] = by_layer.get(Layer.NOTE, []) + by_layer.get(Layer.CROP, [])
    for layer in LAYERS:
        parts = by_layer.get(layer, [])
        for ring in _merged_rings([p for p in parts if isinstance(p, (Boxes, Modules, Shape))]):
            space.add_lwpolyline(ring, close=True, dxfattribs={"layer": str(layer)})
        for part in parts:
            if isinstance(part, Stroke):
                space.add_lwpolyline(part.points_mm.tolist(), close=part.closed, dxfattribs={"layer": str(layer)})
            elif isinstance(part, Text):
                _add_text(space, part)
    document.header["$EXTMIN"] = space.dxf.extmin = (0.0, 0.0, 0.0)
    document.header["$EXTMAX"] = space.dxf.extmax = (drawing.width_mm, drawing.height_mm, 0.0)
    stream = io.StringIO()
    document.write(stream)
    return _undated(stream.getvalue()).encode(document.output_encoding, errors="dxfreplace")


def _merged_rings(parts: list[Part]) -> list[list[tuple[float, float]]]:
    """Outlines and holes of the union of areas, in millimetres."""
    areas: list[BaseGeometry] = []
    for part in parts:
        if isinstance(part, (Boxes, Modules)):
            areas += list(shapely.box(*part.boxes_mm.T))
        elif isinstance(part, Shape):
            areas.append(shapely.Polygon(part.points_mm))
    merged = shapely.get_parts(shapely.union_all(areas))
    return [_ring(shapely.get_coordinates(ring)) for area in merged for ring in (area.exterior, *area.interiors)]


def _ring(points: FloatArray) -> list[tuple[float, float]]:
    return [(x, y) for x, y in np.round(points[:-1], 6).tolist()]


def _add_text(space: Modelspace, text: Text) -> None:
    from ezdxf.enums import TextEntityAlignment

    attributes = {"layer": str(text.layer)}
    if text.layer is Layer.ENGRAVE:
        for contour in contours_mm(text):
            space.add_lwpolyline(np.round(contour, 6).tolist(), close=True, dxfattribs=attributes)
        return
    entity = space.add_text(text.text, height=text.height_mm, dxfattribs=attributes)
    entity.set_placement((text.x_mm, text.y_mm), align=TextEntityAlignment[_ALIGNMENTS[text.anchor]])


def _undated(dxf: str) -> str:
    """Take the time of writing and the random ids out, which ezdxf puts into every file."""
    dxf = _DATES.sub(r"\g<1>2451545.0", dxf)
    dxf = _GUIDS.sub(r"\g<1>{00000000-0000-0000-0000-000000000000}", dxf)
    return _STAMPS.sub(r"\1", dxf)
