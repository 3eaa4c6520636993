"""Uploads that arrive in parts, and quotas."""
