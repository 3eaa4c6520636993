"""/m: pages of markers that need no key, and /v1/damage-reports."""
