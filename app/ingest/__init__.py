"""Live sources of uploads: they collect, keep and send on what a broker delivers."""
