"""Alignment and rules -> markers: where each family stands, and with which code."""

from app.planning.placement.place import place_plan

__all__ = ["place_plan"]
