"""Use cases on roads and linear references."""
