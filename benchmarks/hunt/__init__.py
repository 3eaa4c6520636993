"""Search for scenes that break the decoders."""
