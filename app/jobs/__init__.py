"""Decoding outside the server process: the same task locally and on a distributed engine."""
