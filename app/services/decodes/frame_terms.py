"""What the context of an upload declares of the frames of a drive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from app.errors import InvalidParameter
from app.formats.poses.declaration import PoseDeclaration
from app.services.decodes.packet_task import pose_declaration


@dataclass(frozen=True, slots=True)
class FrameTerms:
    """What is declared of the frames of a drive.

    Attributes
    ----------
    rate_hz : float or None
        Frames a second. [Hz]
    poses : PoseDeclaration
        Of a list of frames, or of a track beside them.
    """

    rate_hz: float | None = None
    poses: PoseDeclaration = field(default_factory=PoseDeclaration)


def frame_terms(declared: Mapping[str, Any]) -> FrameTerms:
    """Check the section `frames` of a context.

    Raises
    ------
    InvalidParameter
        A figure is out of its limits; the field is below ``frames``.
    """
    rate_hz = declared.get("rate_hz")
    if rate_hz is not None and not 0.001 <= rate_hz <= 1000:
        raise InvalidParameter(f"the frame rate is {rate_hz:g}", field="frames.rate_hz", limit="0.001 to 1000 Hz")
    try:
        return FrameTerms(rate_hz, pose_declaration(declared.get("poses") or {}))
    except InvalidParameter as error:
        error.field = f"frames.{error.field}" if error.field else "frames"
        raise
