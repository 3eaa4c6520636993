"""Fits the models of app/planning/data/predictions.json to simulated drives on roads and seeds of their own."""
