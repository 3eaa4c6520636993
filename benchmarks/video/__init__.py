"""Videos of simulated drives: how fast they are decoded, and what the sum of several frames adds to single ones."""
