"""Routes on vehicles, calibrations and snapshots."""
