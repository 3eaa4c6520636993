"""Drives: several decodes of one vehicle as one track."""
