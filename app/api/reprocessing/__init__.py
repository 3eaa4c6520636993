"""Routes on reprocessings."""
