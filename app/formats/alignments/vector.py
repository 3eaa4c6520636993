"""Roads as GeoPackage and zipped Shapefile, by GDAL, after the contents are checked."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from app.errors import ReferenceSystemError, UnreadableUpload
from app.formats.alignments.features import RoadFeature, Shape, assemble_road, check_counts, read_ring, read_vertices
from app.formats.alignments.geometry import AlignmentFile
from app.formats.surveys.gis_reader import list_gpkg_layers, name_crs, plain_values, read_prj, repack_shapefile
from app.formats.surveys.table import MAX_COLUMNS

_MAX_LAYERS = 50  # bounds the time of a file
_SHAPES = {1: Shape.LINE, 2: Shape.LINE, 0: Shape.POINT, 3: Shape.AREA, 4: Shape.POINT, 5: Shape.LINE, 6: Shape.AREA}
"""By GEOS' number of the geometry's type."""


def read_gpkg(data: bytes) -> AlignmentFile:
    """A road of all layers of features of a GeoPackage; a layer's name decides the kind where no property does.

    Raises
    ------
    UnreadableUpload
        It is no GeoPackage, its layers are views or virtual tables, or there are no lines.
    InvalidParameter, ReferenceSystemError
        A feature cannot be used, or layers have different CRSs.
    """
    layers = list_gpkg_layers(data)
    if not 1 <= len(layers) <= _MAX_LAYERS:
        raise _damaged(f"it has {len(layers)} layers of features")
    return _read("gpkg", data, layers)


def read_shapefile(data: bytes) -> AlignmentFile:
    """A road of the one Shapefile in a ZIP archive; errors as for `read_gpkg`."""
    packed = repack_shapefile(data)
    road = _read("shapefile", packed, [None])
    if road.crs is None and (stated := read_prj(packed)) is not None:  # GDAL reads WKT 1 alone
        road = replace(road, crs=name_crs(stated) or stated)
    return road


def _read(format_name: str, data: bytes, layers: list[Any]) -> AlignmentFile:
    features: list[RoadFeature] = []
    systems: dict[str, str | None] = {}
    for layer in layers:
        found, crs = _read_layer(data, layer)
        if found:
            systems[str(layer)] = crs
        features += found
        check_counts(len(features), 0)
    if len(set(systems.values())) > 1:
        stated = ", ".join(f"{layer}: {_short(crs)}" for layer, crs in systems.items())
        raise ReferenceSystemError(
            f"the layers have different CRSs ({stated[:300]})",
            field="crs",
            limit="one CRS for all layers",
            cure="transform all layers to one CRS",
        )
    crs = next(iter(systems.values()), None)
    return assemble_road(format_name, features, crs=crs, unit_m=None)


def _short(crs: str | None) -> str:
    return "none" if crs is None else crs[:60]


def _read_layer(data: bytes, layer: str | None) -> tuple[list[RoadFeature], str | None]:
    from pyogrio import raw, read_info  # type: ignore[import-untyped]

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # GDAL warns of names without suffix
            info = read_info(data, layer=layer)
            check_counts(info["features"], 0)
            if len(info["fields"]) > MAX_COLUMNS:
                raise _damaged(f"it has {len(info['fields'])} fields")
            _meta, _ids, geometry, fields = raw.read(data, layer=layer, datetime_as_string=True)
    except (RuntimeError, ValueError, IndexError) as error:  # GDAL reports damage with any of these
        raise _damaged(f"it cannot be read: {str(error)[:200]}") from error
    if geometry is None:
        return [], None
    names = [str(name).lower() for name in info["fields"]]
    columns = [list(plain_values(column)) for column in fields]
    shapes = shapely.from_wkb(geometry, on_invalid="ignore")
    prefix = "" if layer is None else f"layer {layer}, "
    features = []
    for row, shape in enumerate(shapes):
        kind = _SHAPES.get(shapely.get_type_id(shape))
        parts = tuple(_parts(shape, kind, f"{prefix}feature {row + 1}")) if kind is not None else ()
        if parts and kind is not None:
            values = {name: _plain(column[row]) for name, column in zip(names, columns, strict=True)}
            features.append(RoadFeature(f"{prefix}feature {row + 1}", kind, parts, values, layer or ""))
    stated = info["crs"]
    return features, (name_crs(stated) or stated) if stated else None


def _parts(shape: object, kind: Shape | None, where: str) -> list[npt.NDArray[np.float64]]:
    ones = [one for one in shapely.get_parts(shape) if not shapely.is_empty(one)]
    if kind is Shape.AREA:
        return [read_ring(shapely.get_coordinates(one.exterior, include_z=True), where) for one in ones]
    return [read_vertices(shapely.get_coordinates(one, include_z=True), where) for one in ones]


def _plain(value: object) -> object:
    return value.item() if isinstance(value, np.generic) else value


def _damaged(message: str) -> UnreadableUpload:
    return UnreadableUpload(
        f"the file cannot be used: {message}",
        field="file",
        limit="a GeoPackage or a zipped Shapefile with lines",
        cure="export the layers again",
    )
