"""Providers of the camera, one per file; a file here is found by its name."""
