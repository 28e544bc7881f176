"""What can be said of IMU samples by themselves: faults, standstill, clocks."""
