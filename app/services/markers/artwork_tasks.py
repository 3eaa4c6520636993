"""What decoder processes are asked to do for artwork of many plates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from app.encoders.plate import BundleOptions
from app.encoders.plate.order import PlateOrder
from app.services.decoder_processes import Task

Files = list[tuple[str, bytes]]


@dataclass(frozen=True, slots=True)
class DrawPlateTask(Task[tuple[Files, dict[str, Any]]]):
    """A plate to draw, to prove and to write: its files, and its entry in the manifest.

    Attributes
    ----------
    name : str
        Of the files, without extension.
    """

    order: PlateOrder
    name: str
    options: BundleOptions


@dataclass(frozen=True, slots=True)
class WriteSheetsTask(Task[Files]):
    """Sheets to nest plates on, and the quality sheets."""

    orders: tuple[PlateOrder, ...]
    options: BundleOptions
