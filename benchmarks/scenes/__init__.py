"""Scenes that only benchmarks and tests draw: what is not a plate, thermal frames, faulty prints, odd roads."""
