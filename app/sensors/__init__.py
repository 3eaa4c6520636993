"""What is on the vehicle: the geometry of its sensors."""
