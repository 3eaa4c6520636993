"""Fiducial sign -> artwork at true size, written by the writers of `app.encoders.plate`."""

from app.encoders.fiducial.artwork import FiducialOrder, encode_fiducial
from app.encoders.fiducial.proof import prove_fiducial

__all__ = ["FiducialOrder", "encode_fiducial", "prove_fiducial"]
