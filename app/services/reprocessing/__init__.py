"""Stored uploads are decoded again by the present decoders, and compared reading by reading."""
