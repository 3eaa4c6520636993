"""Pictures of what a camera sees, rendered and decoded inside a decoder process."""

from __future__ import annotations

from app.jobs.memory_limit import memory_is_the_limit
from app.planning.predict.camera_view import render_view
from app.planning.predict.views import CameraView
from app.services.markers.view_task import CameraViewTask


def render_camera_view(task: CameraViewTask, _before: None) -> CameraView:
    """Render one frame and decode it."""
    with memory_is_the_limit("picture", "choose a camera with fewer pixels"):
        return render_view(
            task.code, task.geometry, task.camera, speed_mps=task.speed_mps, ahead_m=task.ahead_m, left_m=task.left_m,
            condition=task.condition,
        )  # fmt: skip
