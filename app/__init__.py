"""Waymark: the registry of machine-readable roads."""

__version__ = "0.1.0"
