"""Routes on markers, codebooks, artwork and searches."""
