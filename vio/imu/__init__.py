"""Checks of IMU samples by themselves: faults, standstill, clocks."""
