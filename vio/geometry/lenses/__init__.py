"""Lens models, one class in one file each, and their registry."""
