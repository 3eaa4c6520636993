"""Magnets, tags, ratios, noise and speed beside the METRO paper's rows and its pipeline."""
