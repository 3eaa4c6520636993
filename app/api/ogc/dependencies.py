"""What the routes of /ogc ask for, as FastAPI dependencies: the collection, the feature, the query, the base URL."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Path, Request

from app.api.http.dependencies import use_cases
from app.api.ogc.parameters import OF_ITEM, ONLY_FORMAT
from app.api.ogc.query import ItemsQuery, crs_parameter, items_query, known_parameters, query_pairs
from app.api.ogc.responses import GEOJSON, JSON, base_url, negotiate
from app.errors import InvalidParameter
from app.services.markers.feature_crs import FeatureCrs
from app.services.markers.features import Collection, Features, get_collection, no_feature

_GEOJSON_NAMES = ("json", "geojson")
_FEATURE_ID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}(\.[0-9]{5,7})?", re.ASCII)


async def get_named_collection(
    collection: Annotated[str, Path(description="Id of the collection.")],
) -> Collection:
    """The collection that the path names."""
    return get_collection(collection)


CollectionOf = Annotated[Collection, Depends(get_named_collection)]


async def get_editable_collection(collection: CollectionOf) -> Collection:
    """The collection that the path names, if clients may edit it.

    Raises
    ------
    InvalidParameter
        It is read only.
    """
    if not collection.editable:
        raise InvalidParameter("this collection is read only", field="collectionId", limit="markers can be edited")
    return collection


async def get_feature_id(
    collection: CollectionOf, feature: Annotated[str, Path(description="Id of the feature.")]
) -> str:
    """The feature's id in the path.

    Raises
    ------
    NotFound
        No feature has such an id.
    """
    if not _FEATURE_ID.fullmatch(feature):
        raise no_feature(collection)
    return feature


async def get_items_query(request: Request, collection: CollectionOf) -> ItemsQuery:
    """The query of a request for items, whose client takes GeoJSON or HTML."""
    pairs = query_pairs(request)
    form = next((value for name, value in pairs if name == "f"), None)
    is_page = negotiate(request, form, GEOJSON, JSON, names=_GEOJSON_NAMES, html=True)
    return items_query(pairs, collection, is_page=is_page)


@dataclass(frozen=True, slots=True)
class ItemQuery:
    """What a request for one item asks for: parameters as they were sent, the CRS, and whether it wants HTML."""

    pairs: list[tuple[str, str]]
    crs: FeatureCrs
    is_page: bool


async def get_item_query(request: Request, _collection: CollectionOf) -> ItemQuery:
    """The query of a request for one item, whose client takes GeoJSON or HTML."""
    found = known_parameters(request, OF_ITEM)
    crs = crs_parameter(found, "crs")
    is_page = negotiate(request, found.get("f"), GEOJSON, JSON, names=_GEOJSON_NAMES, html=True)
    return ItemQuery(list(found.items()), crs, is_page)


async def refuse_parameters(request: Request) -> None:
    """Refuse every query parameter."""
    known_parameters(request, ())


class Offers:
    """A dependency: whether a client gets HTML.

    It refuses clients that take none of the offered media types, and parameters other than `f`.
    """

    def __init__(self, *kinds: str, names: tuple[str, ...] = ("json",), html: bool = False) -> None:
        self._kinds = kinds
        self._names = names
        self._html = html

    async def __call__(self, request: Request) -> bool:
        """Check one request."""
        form = known_parameters(request, ONLY_FORMAT).get("f")
        return negotiate(request, form, *self._kinds, names=self._names, html=self._html)


async def get_base_url(request: Request) -> str:
    """The URL at which the client reaches /ogc."""
    return base_url(request)


EditableCollection = Annotated[Collection, Depends(get_editable_collection)]
FeatureId = Annotated[str, Depends(get_feature_id)]
FeaturesService = Annotated[Features, use_cases("features")]
ItemsQueryOf = Annotated[ItemsQuery, Depends(get_items_query)]
ItemQueryOf = Annotated[ItemQuery, Depends(get_item_query)]
BaseUrl = Annotated[str, Depends(get_base_url)]
