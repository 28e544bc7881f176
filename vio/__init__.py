"""Stereo visual-inertial odometry: datasets, filters, selection, evaluation and results.

Importing this package loads nothing heavy; in particular it never imports torch.
"""

from vio._version import __version__

__all__ = ["__version__"]
