"""The task of a decoder process that estimates a drive's track, and its result."""

from __future__ import annotations

from dataclasses import dataclass, field

from app.services.decoder_processes import Task
from app.services.drives.collect import LeftOutMarker
from app.services.drives.documents import DriveReport
from app.tracks.types import TrackInput, TrackRules


@dataclass(frozen=True, slots=True, eq=False)
class TrackTask(Task["WrittenTrack"]):
    """What is known of a drive.

    Attributes
    ----------
    name : str
    given : TrackInput
    rules : TrackRules
    left_out : tuple of LeftOutMarker
        Before the track was estimated.
    on_lane : tuple of LeftOutMarker
        CERPMs whose path was used.
    warnings : tuple of str
    """

    name: str
    given: TrackInput
    rules: TrackRules
    left_out: tuple[LeftOutMarker, ...] = ()
    on_lane: tuple[LeftOutMarker, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class WrittenTrack:
    """A track as files: content by name, compressed with zlib; and what is stored with the drive."""

    report: DriveReport
    files: dict[str, bytes] = field(default_factory=dict)
