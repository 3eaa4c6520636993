"""Packages of plans, inside a decoder process."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from app.decoders.plate.reader import decode_plates
from app.jobs.memory_limit import memory_is_the_limit
from app.markers.plate import PlateGeometry
from app.markers.reading import PlateReading
from app.planning.outputs.package import Package, PackageOptions, PackagePart
from app.planning.outputs.plan_document import read_plan
from app.services.plans.package_tasks import ListPartsTask, WriteManifestTask, WritePartTask

_CURE = "cut the road into sections"


def list_package_parts(task: ListPartsTask, _before: None) -> list[PackagePart]:
    """Divide a package into parts."""
    with memory_is_the_limit("plan", _CURE):
        package = _package(task.document, task.options)
        package.check()
        return [] if task.only_check else package.parts()


def write_package_part(task: WritePartTask, _before: None) -> list[tuple[str, bytes]]:
    """Write a part of a package."""
    with memory_is_the_limit("plan", _CURE):
        return _package(task.document, task.options).write(task.part, read_face)


def write_package_manifest(task: WriteManifestTask, _before: None) -> bytes:
    """Write the manifest of a package."""
    return _package(task.document, task.options).manifest(task.entries)


def read_face(image: npt.NDArray[np.uint8], geometry: PlateGeometry) -> Sequence[PlateReading]:
    """The plate decoder as the self-proof of artwork wants it."""
    return decode_plates(image, geometries=(geometry,))


@lru_cache(maxsize=1)
def _package(document: bytes, options: PackageOptions) -> Package:
    """A plan with what its parts share: one a process, kept until another plan is packed."""
    return Package(read_plan(zlib.decompress(document)), options)
