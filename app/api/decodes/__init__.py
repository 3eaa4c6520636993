"""Routes on uploads and their decodes."""
