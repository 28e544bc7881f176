"""Numerical helpers that know nothing of cameras: compiled loops, robust statistics, threads."""
