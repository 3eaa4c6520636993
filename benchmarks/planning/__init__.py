"""Plans of whole roads: speed and growth, predictions against proofs, the optimiser, commits, the papers' set-ups."""
