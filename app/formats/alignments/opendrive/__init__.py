"""Roads of ASAM OpenDRIVE, 1.4 to 1.8."""

from app.formats.alignments.opendrive.read import read_opendrive

__all__ = ["read_opendrive"]
