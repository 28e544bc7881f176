"""Trajectories against ground truth."""
