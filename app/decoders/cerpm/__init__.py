"""Received packets of CERPMs to verified markers."""
