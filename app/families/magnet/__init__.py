"""The family of magnet markers: information tags and line tags."""
