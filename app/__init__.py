"""Waymark: the registry of machine-readable roads."""

from pathlib import Path

__version__ = "0.2.0"


def shipped_folder(name: str) -> Path:
    """Folder of files that belong to the package: inside it where a wheel is installed, beside it in a checkout."""
    package = Path(__file__).resolve().parent
    inside = package / name
    return inside if inside.is_dir() else package.parent / name
