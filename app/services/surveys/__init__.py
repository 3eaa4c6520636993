"""Use cases on imports and exports of markers."""
