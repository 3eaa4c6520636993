"""Routes about jobs of every kind, and about events."""
