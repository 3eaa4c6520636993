"""A drive over magnets, from the dipoles in the road to the samples of the bar."""
