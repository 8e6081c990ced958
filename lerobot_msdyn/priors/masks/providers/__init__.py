"""Providers of masks, one per file; a file here is found by its name."""
