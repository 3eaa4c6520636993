"""What decoder processes are asked to do for packages of plans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from app.planning.outputs.package import PackageOptions, PackagePart
from app.services.decoder_processes import Task


@dataclass(frozen=True, slots=True)
class ListPartsTask(Task[list[PackagePart]]):
    """A package to divide into parts; of one that is only checked, the list is empty."""

    document: bytes
    options: PackageOptions
    only_check: bool = False


@dataclass(frozen=True, slots=True)
class WritePartTask(Task[list[tuple[str, bytes]]]):
    """A part of a package to write: names and contents of its files."""

    document: bytes
    options: PackageOptions
    part: PackagePart


@dataclass(frozen=True, slots=True)
class WriteManifestTask(Task[bytes]):
    """The manifest of a package to write."""

    document: bytes
    options: PackageOptions
    entries: list[dict[str, Any]]
