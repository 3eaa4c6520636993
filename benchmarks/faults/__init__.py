"""Faults: kills, failing disks and slow clients against `waymark serve`, each with what has to be true afterwards."""
