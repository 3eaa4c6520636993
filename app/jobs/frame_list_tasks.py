"""Lists of frames and tracks beside them, read inside a decoder process."""

from __future__ import annotations

from dataclasses import replace

from app.formats.frame_list import is_frame_list, read_frame_list
from app.formats.poses.read import read_poses
from app.services.decodes.frame_poses import FrameLists, FrameListTask, describe_report


def read_frame_lists(task: FrameListTask, _before: None) -> FrameLists:
    """Read the first list of frames and the first track."""
    read = FrameLists()
    for name, data in task.files:
        if is_frame_list(name):
            if read.frames is None:
                frames = read_frame_list(name, data, task.declaration)
                read = replace(read, frames=frames, warnings=(*read.warnings, *describe_report(name, frames.report)))
                continue
        elif read.track is None:
            track, report = read_poses(name, data, task.declaration, task.limits)
            read = replace(read, track=track, warnings=(*read.warnings, *describe_report(name, report)))
            continue
        read = replace(read, warnings=(*read.warnings, f"{name} is not used: there is another file of its kind"))
    return read
