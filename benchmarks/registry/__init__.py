"""The registry at a million rows: boxes and tiles through HTTP beside tipg, searches at the service, growth."""
