"""Routes on drives."""
