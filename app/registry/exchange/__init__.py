"""Markers from and to the files of surveyors and GIS: readers, checks, comparisons, writers. Bytes in, values out."""
