"""A rendered stereo-inertial world with exact truth; see docs/simulation.md."""
