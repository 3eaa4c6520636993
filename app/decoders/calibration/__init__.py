"""Photos of a calibration board -> the camera's intrinsics and distortion, and how sure they are."""
