"""The family of chip-enabled raised pavement markers."""
