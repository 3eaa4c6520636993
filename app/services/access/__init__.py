"""Agencies, keys, tokens and the audit log."""
