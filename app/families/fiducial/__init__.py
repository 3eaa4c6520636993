"""The family of square fiducial signs: ArUco and AprilTag."""
