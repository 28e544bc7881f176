"""Lie groups and the rectified stereo camera: pure functions over float64 arrays."""
