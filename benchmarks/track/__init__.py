"""Tracks of simulated drives with markers of all families, against the truth and against single sensors."""
