"""Files that a vehicle recorded -> magnetometer traces, with a report of what was left out."""
