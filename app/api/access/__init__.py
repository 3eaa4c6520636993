"""Routes on keys and the audit log."""
