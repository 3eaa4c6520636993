"""Recorded inputs with a promise: so many are read at least, and none wrongly."""
