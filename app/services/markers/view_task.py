"""What decoder processes are asked to do for pictures of what a camera sees: plain values that can be pickled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from app.markers.plate import PlateCode, PlateGeometry
from app.planning.predict.views import CameraView
from app.planning.proof.terms import Condition
from app.planning.rules import CameraRules
from app.services.decoder_processes import Task


@dataclass(frozen=True, slots=True)
class CameraViewTask(Task[CameraView]):
    """A plate to render as a camera sees it, and to decode.

    Attributes
    ----------
    code : PlateCode
    geometry : PlateGeometry
    camera : CameraRules
    speed_mps : float
        [m/s]
    ahead_m, left_m : float
        The plate's centre from the camera. [m]
    condition : Condition
    """

    is_long: ClassVar[bool] = False

    code: PlateCode
    geometry: PlateGeometry
    camera: CameraRules
    speed_mps: float
    ahead_m: float
    left_m: float
    condition: Condition
