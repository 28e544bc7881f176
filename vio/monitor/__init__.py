"""Monitoring of a run without influence on it: plausibility of the IMU data and of the estimate.

This package does not depend on readers, front ends or filters.
"""
