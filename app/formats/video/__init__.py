"""Videos: which files are videos, what they hold, and their frames."""
