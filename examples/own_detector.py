"""A detector of one's own: an image in, corners out; tracking and stereo matching are built in.

python examples/own_detector.py                                    # checked on rendered images
vio run RECORDING --frontend examples/own_detector.py:FastCorners  # used in a run
"""

import cv2
import numpy as np

from vio.testing import check_frontend


class FastCorners:
    """FAST corners, the strongest first; put a network in its place."""

    def __init__(self):
        self.fast = cv2.FastFeatureDetector_create(threshold=12)

    def detect(self, image):
        """Return corners (K, 2) [u v] of a gray image, pixels."""
        found = sorted(self.fast.detect(image), key=lambda corner: -corner.response)
        return np.array([corner.pt for corner in found]).reshape(-1, 2)


if __name__ == "__main__":
    print("checking on 40 rendered frames", flush=True)
    print(check_frontend(FastCorners))
