"""Magnet tag -> what is built: codebooks, layouts, drilling sheets."""
