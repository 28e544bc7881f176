"""Calibration with a printed board: its description and print, its corners, cameras, IMU and
verdict.
"""
