"""Predicted read rates and path errors: models fitted to simulated drives."""
