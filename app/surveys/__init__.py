"""Checks of a survey: where its rows lie, what contradicts what, and how it compares with the plan."""
