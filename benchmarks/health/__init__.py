"""Marker health: simulated drives with honest errors past markers, some of which have faults."""
