"""Artwork of many plates, inside a decoder process."""

from __future__ import annotations

from typing import Any

from app.encoders.plate.bundle import plate_files, sheet_files
from app.jobs.memory_limit import memory_is_the_limit
from app.jobs.package_tasks import read_face
from app.services.markers.artwork_tasks import DrawPlateTask, Files, WriteSheetsTask


def draw_plate(task: DrawPlateTask, _before: None) -> tuple[Files, dict[str, Any]]:
    """Draw a plate, read it back, and write its files."""
    return plate_files(task.order, task.name, task.options, read_face)


def write_sheets(task: WriteSheetsTask, _before: None) -> Files:
    """Write the sheets of all plates."""
    with memory_is_the_limit("sheet", "select fewer plates"):
        return sheet_files(task.orders, task.options)
