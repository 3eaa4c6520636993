"""Where markers go, whether a plan works, and what it costs."""
