"""Marker health: what uploads show of markers, the tests on it, and the work list."""
