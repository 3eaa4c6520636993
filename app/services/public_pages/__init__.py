"""Public pages of markers, and the damage reports that come from them."""
