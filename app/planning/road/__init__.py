"""From lines of a file to lanes in WGS 84: reference systems, true distances, directions, checks and events."""
