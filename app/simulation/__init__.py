"""Scene -> signal: what a sensor on a vehicle would record."""
