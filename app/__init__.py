"""Waymark: the registry of machine-readable roads."""

__version__ = "0.2.0"
