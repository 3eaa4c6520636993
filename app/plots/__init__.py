"""Plots and drawings over frames."""
