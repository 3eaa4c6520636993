"""Damaged inputs for every parser and for the decoder processes, and the registry beside a model."""
