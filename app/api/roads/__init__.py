"""Routes on roads."""
