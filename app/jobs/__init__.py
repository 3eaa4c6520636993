"""Decoder processes, the functions that they call, and the queue of jobs."""
