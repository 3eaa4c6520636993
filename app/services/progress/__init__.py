"""Jobs of every kind as one resource: their progress, their end, and where the result is."""
