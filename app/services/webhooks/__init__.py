"""Webhooks: events of an agency, sent to addresses that it chose."""
