"""Packets of CERPMs -> verified markers, the lane between them, and a check of steering along it."""
