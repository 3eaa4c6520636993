"""Drives past CERPMs: the lane, its markers, the radio between them and a vehicle, and who meddles with it."""
