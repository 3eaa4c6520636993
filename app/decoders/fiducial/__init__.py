"""Frames -> readings of fiducial signs."""

from app.decoders.fiducial.decode import decode_fiducials
from app.decoders.fiducial.reading import FiducialOutcome, FiducialReading

__all__ = ["FiducialOutcome", "FiducialReading", "decode_fiducials"]
