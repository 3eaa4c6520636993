"""Routes of marker health: the work list, and the tests of a marker."""
