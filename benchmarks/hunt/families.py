"""The families of scenes by name."""

from __future__ import annotations

from benchmarks.hunt.cerpm import CerpmScenes
from benchmarks.hunt.magnet import MagnetScenes
from benchmarks.hunt.plate import PlateScenes
from benchmarks.hunt.scenes import Family

FAMILIES: dict[str, Family] = {"cerpm": CerpmScenes(), "magnet": MagnetScenes(), "plate": PlateScenes()}
