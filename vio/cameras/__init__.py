"""The calibration of cameras and IMU as given by the user."""
