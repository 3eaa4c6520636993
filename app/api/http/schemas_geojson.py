"""Schemas of the GeoJSON geometries that requests carry (RFC 7946)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, FailFast, Field

from app.api.http.dependencies import Number

# Long lists stop at their first error: a body of 1 MiB has room for 200,000 of them.
Position = Annotated[list[Number], Field(min_length=2, max_length=4), FailFast()]
Line = Annotated[list[Position], Field(min_length=2), FailFast()]
Ring = Annotated[list[Position], Field(min_length=4), FailFast()]


class _Geometry(BaseModel):
    model_config = ConfigDict(extra="ignore")  # RFC 7946, section 6.1: foreign members


class GeoLineIn(_Geometry):
    """A line."""

    type: Literal["LineString"]
    coordinates: Line


class MultiLineStringIn(_Geometry):
    """Several lines."""

    type: Literal["MultiLineString"]
    coordinates: Annotated[list[Line], Field(min_length=1), FailFast()]


class PolygonIn(_Geometry):
    """A polygon: its outer ring, then its holes."""

    type: Literal["Polygon"]
    coordinates: Annotated[list[Ring], Field(min_length=1), FailFast()]


class MultiPolygonIn(_Geometry):
    """Several polygons."""

    type: Literal["MultiPolygon"]
    coordinates: Annotated[
        list[Annotated[list[Ring], Field(min_length=1), FailFast()]], Field(min_length=1), FailFast()
    ]


AnyLine = Annotated[GeoLineIn | MultiLineStringIn, Field(discriminator="type")]
AnyPolygon = Annotated[PolygonIn | MultiPolygonIn, Field(discriminator="type")]
