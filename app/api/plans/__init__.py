"""Routes on plans."""
