"""A drive's track, inside a decoder process."""

from __future__ import annotations

import zlib

from app.jobs.memory_limit import memory_is_the_limit
from app.services.drives.documents import track_report
from app.services.drives.track_task import TrackTask, WrittenTrack


def write_track(task: TrackTask, _before: None) -> WrittenTrack:
    """Estimate a track and write its files."""
    from app.plots.track import plot_track  # only here: numba takes a second to load
    from app.tracks.estimate import estimate_track
    from app.tracks.files import write_csv, write_geojson, write_gpx

    with memory_is_the_limit("drive", "make several drives of it"):
        track = estimate_track(task.given, task.rules)
        others = [
            {
                "marker_id": entry.marker_id, "family": entry.family, "decode_id": entry.decode_id,
                "place": entry.place, "used": False, "reason": str(entry.reason), "detail": entry.detail,
            }
            for entry in task.left_out
        ]  # fmt: skip
        texts = {
            "track.geojson": write_geojson(track, task.name, others),
            "track.csv": write_csv(track),
            "track.gpx": write_gpx(track, task.name),
            "plot.svg": plot_track(track, task.name),
        }
        report = track_report(track, task.left_out, task.on_lane, task.warnings)
        return WrittenTrack(report, {name: zlib.compress(text.encode()) for name, text in texts.items()})
