"""Signal -> reading."""
