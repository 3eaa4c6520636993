"""Lanes from markers: the reference path, its image in a camera frame, and control along it.

Constants chosen by hand quote ``sensitivity a, b``: the error with half and with twice the value, over the error with
the value itself, on 196 simulated drives (``python -m benchmarks.cerpm.sensitivity``, seed 61, error 0.056 m).
"""
