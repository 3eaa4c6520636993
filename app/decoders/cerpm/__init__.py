"""Received packets of CERPMs to verified markers.

A value without a source beside it was chosen by hand; `python -m benchmarks.cerpm` checks all of them together.
"""
