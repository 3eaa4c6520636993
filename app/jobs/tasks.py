"""The functions that decoder processes call: one line for each step of each task."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from app.jobs.artwork_tasks import draw_plate, write_sheets
from app.jobs.calibration_tasks import calibrate_photos
from app.jobs.decoder_process import ProcessIdTask, process_id
from app.jobs.frame_list_tasks import read_frame_lists
from app.jobs.frame_tasks import annotate_frame, decode_run, find_markers, load_frame
from app.jobs.package_tasks import list_package_parts, write_package_manifest, write_package_part
from app.jobs.packet_tasks import draw_overlay, estimate_lane, read_drive
from app.jobs.plan_tasks import compare_plan, make_plan, profile_road, summarize_road, write_file_of_plan, write_map
from app.jobs.print_tasks import grade_photo
from app.jobs.proof_tasks import list_proof_units, prove_unit, write_proof
from app.jobs.report_photo_tasks import write_report_photo
from app.jobs.sample_tasks import draw_video_frame, read_samples
from app.jobs.survey_tasks import read_survey_file
from app.jobs.trace_tasks import compile_traces, decode_recording
from app.jobs.track_tasks import write_track
from app.jobs.video_tasks import decode_segment, index_frames
from app.jobs.view_tasks import render_camera_view
from app.services.decoder_processes import Task
from app.services.decodes.frame_poses import FrameListTask
from app.services.decodes.frame_task import AnnotationTask, FramePicture, FrameRunTask, FrameSearch
from app.services.decodes.packet_task import DriveTask, LaneTask, OverlayTask
from app.services.decodes.sample_task import SamplesTask, VideoFrameTask
from app.services.decodes.trace_task import CompileTracesTask, TraceTask
from app.services.decodes.video_task import IndexVideoTask, SegmentTask
from app.services.drives.track_task import TrackTask
from app.services.fleet.calibrations import CalibrationTask
from app.services.markers.artwork_tasks import DrawPlateTask, WriteSheetsTask
from app.services.markers.print_task import PrintGradeTask
from app.services.markers.view_task import CameraViewTask
from app.services.plans.package_tasks import ListPartsTask, WriteManifestTask, WritePartTask
from app.services.plans.proof_tasks import ListUnitsTask, ProveUnitTask, WriteProofTask
from app.services.plans.tasks import (
    CompareTask,
    MakePlanTask,
    ProfileRoadTask,
    SummarizeRoadTask,
    WriteMapTask,
    WritePlanFileTask,
)
from app.services.public_pages.report_photo import ReportPhotoTask
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
