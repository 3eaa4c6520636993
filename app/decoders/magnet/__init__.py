"""Magnetometer traces -> magnets, line crossings and tags: `decoder.decode_trace`.

A value without a source beside it was chosen by hand. `python -m benchmarks.magnets` checks all of them together:
magnets and tags that are found and wrong, places and times.
"""
