"""Orders to drawings: one plate on its sheet, or many nested on sheets of a chosen size."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from app.encoders.plate.drawing import Drawing, Part, moved
from app.encoders.plate.face import code_face, fixed_face
from app.encoders.plate.margin import (
    BLEED_MM,
    BOTTOM_MARGIN_MM,
    SIDE_MARGIN_MM,
    TOP_MARGIN_MM,
    fixed_margin,
    plate_margin,
)
from app.encoders.plate.order import ArtworkOptions, PlateOrder
from app.errors import InvalidParameter
from app.markers.plate import PlateGeometry

PLAIN = ArtworkOptions()
MAX_SHEET_MM = 5000.0


def tile_mm(geometry: PlateGeometry) -> tuple[float, float]:
    """Width and height of a plate with its margins. [mm]"""
    return geometry.side_mm + 2 * SIDE_MARGIN_MM, geometry.side_mm + TOP_MARGIN_MM + BOTTOM_MARGIN_MM


def encode_plate(order: PlateOrder, options: ArtworkOptions = PLAIN) -> Drawing:
    """Draw one plate at true size, with the information for the workshop in its margin.

    Parameters
    ----------
    order : PlateOrder
    options : ArtworkOptions
        Heaters and light sources under the face.

    Returns
    -------
    Drawing
        A sheet that is 20 mm wider than the plate on both sides, 36 mm above and 72 mm below. [mm]
    """
    width, height = tile_mm(order.geometry)
    left, bottom = SIDE_MARGIN_MM, BOTTOM_MARGIN_MM
    side = order.geometry.side_mm
    return Drawing(
        title=f"{order.plate_id} r{order.revision} {order.code.digits}",
        width_mm=width,
        height_mm=height,
        parts=_plate_parts(order, options, left, bottom),
        trim_mm=((left, bottom, left + side, bottom + side),),
        bleed_mm=BLEED_MM,
    )


def encode_sheets(
    orders: Sequence[PlateOrder], *, width_mm: float, height_mm: float, options: ArtworkOptions = PLAIN
) -> list[Drawing]:
    """Nest many plates on sheets, in a grid of the largest plate's size, row by row from the top.

    Parameters
    ----------
    orders : sequence of PlateOrder
    width_mm, height_mm : float
        The sheet, at most 5000. [mm]
    options : ArtworkOptions

    Raises
    ------
    InvalidParameter
        The sheet is too small for one plate with its margins, or there are no plates.
    """
    if not orders:
        raise InvalidParameter("there are no plates to nest", field="plates", limit="1 or more")
    tiles = [tile_mm(order.geometry) for order in orders]
    tile_width, tile_height = max(w for w, _ in tiles), max(h for _, h in tiles)
    for name, value, minimum in (("width_mm", width_mm, tile_width), ("height_mm", height_mm, tile_height)):
        if not minimum <= value <= MAX_SHEET_MM:
            raise InvalidParameter(
                f"{name} of the sheet is {value:g} mm, the largest plate needs {minimum:g} mm with its margins",
                field=f"sheet.{name}",
                limit=f"{minimum:g} to {MAX_SHEET_MM:g} mm",
                cure="choose a larger sheet, or smaller plates",
            )
    columns, rows = int(width_mm // tile_width), int(height_mm // tile_height)
    per_sheet = columns * rows
    batches = [orders[i : i + per_sheet] for i in range(0, len(orders), per_sheet)]
    sheets = []
    for number, batch in enumerate(batches, start=1):
        parts: list[Part] = []
        trims = []
        for k, order in enumerate(batch):
            left = (k % columns) * tile_width + SIDE_MARGIN_MM
            bottom = height_mm - (k // columns + 1) * tile_height + BOTTOM_MARGIN_MM
            side = order.geometry.side_mm
            parts += _plate_parts(order, options, left, bottom)
            trims.append((left, bottom, left + side, bottom + side))
        title = f"sheet {number} of {len(batches)}, {len(batch)} plates"
        sheets.append(Drawing(title, width_mm, height_mm, tuple(parts), tuple(trims), BLEED_MM))
    return sheets


def _plate_parts(order: PlateOrder, options: ArtworkOptions, left: float, bottom: float) -> tuple[Part, ...]:
    x, y = left + order.geometry.side_mm / 2, bottom + order.geometry.side_mm / 2
    own = (*code_face(order.code, order.geometry, options), *plate_margin(order))
    return (*_fixed_parts(order.geometry, options, x, y), *moved(own, x, y))


@lru_cache(maxsize=256)
def _fixed_parts(geometry: PlateGeometry, options: ArtworkOptions, x: float, y: float) -> tuple[Part, ...]:
    return moved((*fixed_face(geometry, options), *fixed_margin(geometry)), x, y)
