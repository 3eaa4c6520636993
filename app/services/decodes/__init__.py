"""Use cases on uploads and their decodes."""
