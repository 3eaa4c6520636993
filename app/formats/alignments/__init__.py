"""Files with roads: lane centre lines or boundaries, events along them, and areas to avoid."""
