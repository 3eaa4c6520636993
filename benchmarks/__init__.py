"""Measurements beside the papers and peers. Each module runs as ``python -m benchmarks.NAME``."""
