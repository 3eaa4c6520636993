"""A vehicle's own track: CSV, GPX and NMEA 0183."""
