"""Use cases on markers, codebooks, artwork and searches."""
