"""Magnetometer traces -> magnets, line crossings and tags."""
