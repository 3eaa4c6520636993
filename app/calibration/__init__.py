"""Photos of a calibration board to a camera's intrinsics and distortion with their standard deviations."""
