"""The functions that decoder processes call: one line for each step of each task."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from app.jobs.decoder_process import ProcessIdTask, process_id
from app.jobs.drive_tasks import compile_traces, decode_recording, draw_overlay, estimate_lane, read_drive, write_track
from app.jobs.frame_tasks import annotate_frame, decode_run, find_markers, load_frame
from app.jobs.picture_tasks import (
    calibrate_photos,
    draw_plate,
    grade_photo,
    render_camera_view,
    write_report_photo,
    write_sheets,
)
from app.jobs.plan_tasks import (
    compare_plan,
    list_package_parts,
    list_proof_units,
    make_plan,
    profile_road,
    prove_unit,
    read_survey_file,
    summarize_road,
    write_file_of_plan,
    write_map,
    write_package_manifest,
    write_package_part,
    write_proof,
)
from app.jobs.video_tasks import decode_segment, draw_video_frame, index_frames, read_frame_lists, read_samples
from app.services.decodes.frame_poses import FrameListTask
from app.services.decodes.tasks import (
    AnnotationTask,
    CompileTracesTask,
    DriveTask,
    FramePicture,
    FrameRunTask,
    FrameSearch,
    IndexVideoTask,
    LaneTask,
    OverlayTask,
    SamplesTask,
    SegmentTask,
    TraceTask,
    VideoFrameTask,
)
from app.services.drives.documents import TrackTask
from app.services.fleet.calibrations import CalibrationTask
from app.services.markers.tasks import CameraViewTask, DrawPlateTask, PrintGradeTask, WriteSheetsTask
from app.services.plans.tasks import (
    CompareTask,
    ListPartsTask,
    ListUnitsTask,
    MakePlanTask,
    ProfileRoadTask,
    ProveUnitTask,
    SummarizeRoadTask,
    WriteManifestTask,
    WriteMapTask,
    WritePartTask,
    WritePlanFileTask,
    WriteProofTask,
)
from app.services.ports import Task
from app.services.public_pages.pages import ReportPhotoTask
from app.services.surveys.imports import SurveyTask

ResultT = TypeVar("ResultT")
StepFunction = Callable[[Any, Any], Any]
"""Called with the step's argument and the result of the step before it; None for the first."""

STEPS: dict[type, StepFunction] = {
    FramePicture: load_frame,
    FrameSearch: find_markers,
    FrameRunTask: decode_run,
    AnnotationTask: annotate_frame,
    FrameListTask: read_frame_lists,
    TraceTask: decode_recording,
    CompileTracesTask: compile_traces,
    SamplesTask: read_samples,
    VideoFrameTask: draw_video_frame,
    IndexVideoTask: index_frames,
    SegmentTask: decode_segment,
    DriveTask: read_drive,
    LaneTask: estimate_lane,
    OverlayTask: draw_overlay,
    SurveyTask: read_survey_file,
    CalibrationTask: calibrate_photos,
    SummarizeRoadTask: summarize_road,
    ProfileRoadTask: profile_road,
    MakePlanTask: make_plan,
    WritePlanFileTask: write_file_of_plan,
    WriteMapTask: write_map,
    CompareTask: compare_plan,
    ListUnitsTask: list_proof_units,
    ProveUnitTask: prove_unit,
    WriteProofTask: write_proof,
    ListPartsTask: list_package_parts,
    WritePartTask: write_package_part,
    WriteManifestTask: write_package_manifest,
    DrawPlateTask: draw_plate,
    WriteSheetsTask: write_sheets,
    TrackTask: write_track,
    PrintGradeTask: grade_photo,
    CameraViewTask: render_camera_view,
    ReportPhotoTask: write_report_photo,
    ProcessIdTask: process_id,
}


class Finished(Generic[ResultT]):
    """A task that is done."""

    def __init__(self, result: ResultT) -> None:
        self._result = result

    def result(self) -> ResultT:
        """The result."""
        return self._result

    def cancel(self) -> None:
        """Nothing is left to stop."""


class SameProcess:
    """Carries tasks out in this process: an operator's own files need no process with limits."""

    def submit(self, task: Task[ResultT], *, wait_s: float = 0.0) -> Finished[ResultT]:
        """Carry a task out."""
        result: Any = None
        for argument in task.steps():
            result = STEPS[type(argument)](argument, result)
        return Finished(result)
