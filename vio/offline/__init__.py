"""Offline processing: calibration from a recording; check, refinement and export of a run, with
COLMAP.

The commands of the same names parse arguments, call these functions and print. This package may
depend on readers, mapping and COLMAP; only the command line depends on it.
"""
