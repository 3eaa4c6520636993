"""The family of plates."""
