"""CERPMs: their messages, what they are programmed with, and what their radio allows."""
