"""Providers of point tracks, one per file; a file here is found by its name."""
