"""Uploads and artwork: a local folder or S3."""
