"""Imports: surveys with planted faults, clean surveys, rows a second."""
