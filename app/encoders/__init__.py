"""Marker -> what is built."""
