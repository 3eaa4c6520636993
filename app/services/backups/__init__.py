"""Backups of the database and the blobs, also of a running server, and what brings them back."""
