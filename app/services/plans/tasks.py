"""What decoder processes are asked to do for plans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from app.formats.spooled_file import SpooledFile
from app.planning.alignment_declaration import AlignmentDeclaration
from app.planning.plan_checks import ExistingMarker
from app.registry.columns import Columns
from app.registry.marker_rows import MarkerRow
from app.registry.plans import BuiltRow
from app.services.decoder_processes import Task
from app.services.plans.documents import AlignmentProfile, AsBuiltDocument
from app.services.plans.features import LaneFeature


@dataclass(frozen=True, slots=True)
class RoadFile:
    """A file with a road, as it came, and what is declared of it."""

    file: SpooledFile
    file_name: str
    declaration: AlignmentDeclaration
    name: str
    accuracy_m: float


@dataclass(frozen=True, slots=True)
class SummarizedRoad:
    """A road that was read: its document, and its lanes for GIS clients."""

    summary: dict[str, Any]
    lanes: list[LaneFeature]


@dataclass(frozen=True, slots=True)
class SummarizeRoadTask(Task[SummarizedRoad]):
    """A road to read: its lanes, events, warnings and extent."""

    road: RoadFile


@dataclass(frozen=True, slots=True)
class ProfileRoadTask(Task[AlignmentProfile]):
    """A road to draw: its lanes with at most so many samples each."""

    road: RoadFile
    samples: int


MapForm = Literal["osm", "xodr"]
"""Formats of HD maps by the ends of their files' names."""


@dataclass(frozen=True, slots=True)
class WriteMapTask(Task[bytes]):
    """An HD map to write: a road, and the markers near it.

    Attributes
    ----------
    road : RoadFile
    form : str
        ``osm`` for lanelet2, ``xodr`` for OpenDRIVE.
    markers : tuple of MarkerRow
        Of the registry; those that are farther from the road are left out.
    within_m : float
        Greatest distance of a marker from the centre line of a lane. [m]
    """

    road: RoadFile
    form: MapForm
    markers: tuple[MarkerRow, ...]
    within_m: float


@dataclass(frozen=True, slots=True)
class MadePlan:
    """A plan that was placed and checked.

    Attributes
    ----------
    document : bytes
        As `app.planning.outputs.plan_document.write_plan` writes it, compressed by zlib.
    summary : dict
        What lists and the plan's page show.
    numbers : tuple of (family, code)
        Codes that no other marker may have.
    features : Columns
        The markers for GIS clients.
    """

    document: bytes
    summary: dict[str, Any]
    numbers: tuple[tuple[str, str], ...]
    features: Columns


@dataclass(frozen=True, slots=True)
class MakePlanTask(Task[MadePlan]):
    """A plan to place and to check.

    Attributes
    ----------
    taken : frozenset of int
        Registry numbers that other markers have.
    existing : tuple of ExistingMarker
        Markers of the registry near the road.
    codebook : dict or None
        Document of the agency's codebook.
    """

    road: RoadFile
    rules: dict[str, Any]
    name: str
    taken: frozenset[int] = frozenset()
    existing: tuple[ExistingMarker, ...] = ()
    codebook: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class WritePlanFileTask(Task[bytes]):
    """A file of a plan to write: its name, and CRS and unit of the stakeout."""

    document: bytes
    name: str
    crs: str | None = None
    unit: str | None = None


@dataclass(frozen=True, slots=True)
class CompareTask(Task[AsBuiltDocument]):
    """A committed plan to compare with the markers that it became.

    Attributes
    ----------
    document : bytes
    built : tuple of BuiltRow
    existing : tuple of ExistingMarker
        Other markers of the registry near the road.
    """

    document: bytes
    built: tuple[BuiltRow, ...]
    existing: tuple[ExistingMarker, ...]
