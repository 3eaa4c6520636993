"""Uploaded and exported files: bytes in, values out, and back."""
