"""Examine a recording before a run: what was understood of it, and whether a run makes sense."""
