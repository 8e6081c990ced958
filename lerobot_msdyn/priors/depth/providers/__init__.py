"""Providers of depth, one per file; a file here is found by its name."""
