"""The track of a drive, estimated in a decoder process."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace

from app.services.decoder_tasks import decoder_task
from app.services.drives.documents import DriveReport, track_report
from app.tracks.types import DriveMarker, TrackInput, TrackRules


@dataclass(frozen=True, slots=True, eq=False)
class WrittenTrack:
    """A track as files: content by name, compressed with zlib; and what is stored with the drive."""

    report: DriveReport
    files: dict[str, bytes] = field(default_factory=dict)


@decoder_task("drive", "make several drives of it")
def write_track(
    name: str,
    drive: TrackInput,
    rules: TrackRules,
    left_out: tuple[DriveMarker, ...] = (),
    on_lane: tuple[DriveMarker, ...] = (),
    warnings: tuple[str, ...] = (),
) -> WrittenTrack:
    """Estimate a track and write its files.

    `left_out` were left out before; `on_lane` are CERPMs whose path was used.
    """
    from app.plots.track import plot_track
    from app.tracks.estimate import estimate_track  # not loaded before: numba takes a second
    from app.tracks.files import fix_marker, write_csv, write_geojson, write_gpx

    track = estimate_track(drive, rules)
    used = track.path_points > 0
    passed = [replace(marker, used=True, reason=None, detail=None) if used else marker for marker in on_lane]
    markers = [*(fix_marker(result) for result in track.fixes), *left_out, *passed]
    texts = {
        "track.geojson": write_geojson(track, name, markers),
        "track.csv": write_csv(track),
        "track.gpx": write_gpx(track, name),
        "plot.svg": plot_track(track, name),
    }
    report = track_report(track, markers, warnings)
    return WrittenTrack(report, {name: zlib.compress(text.encode()) for name, text in texts.items()})
