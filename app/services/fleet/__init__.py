"""Use cases on vehicles, calibrations and snapshots."""
