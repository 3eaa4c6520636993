"""Use cases on plans: nothing is stored."""
