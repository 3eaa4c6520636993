"""Routes on imports and exports of markers."""
