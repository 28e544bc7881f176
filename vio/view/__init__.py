"""Runs in the rerun viewer, while they go on or from their folders; the only package that
imports rerun.
"""
