"""A front end of one's own in thirty lines: checked on rendered images, then used in place of the
built-in one.

python examples/own_frontend.py [FOLDER]        # without a folder: the demo's street
"""

import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from vio import Parts, evaluate, load_config, open_dataset, run
from vio.records import FrontendOutput, observations
from vio.testing import check_frontend


class CornersAndFlow:
    """Shi-Tomasi corners, followed from frame to frame and into the right image by Lucas-Kanade."""

    def __init__(self, camera):
        self.left = None
        self.ids = np.zeros(0, int)
        self.points = np.zeros((0, 2), np.float32)
        self.next_id = 0

    def process(self, frame, prior=None):
        """Return ids and pixels [ul vl ur vr] of a rectified pair."""
        if self.left is not None and len(self.points):
            moved, found = flow(self.left, frame.left, self.points)
            back, returned = flow(frame.left, self.left, moved)
            keep = found & returned & (np.linalg.norm(back - self.points, axis=1) < 0.5)
            self.points = moved[keep]
            self.ids = self.ids[keep]
        tracked = len(self.points)
        new = self.corners(frame.left)
        self.points = np.concatenate([self.points, new]).astype(np.float32)
        self.ids = np.concatenate([self.ids, self.next_id + np.arange(len(new))])
        self.next_id += len(new)
        self.left = frame.left
        right, matched = flow(frame.left, frame.right, self.points)
        matched &= np.abs(right - self.points)[:, 1] < 1.5  # rows of a rectified pair agree
        matched &= right[:, 0] < self.points[:, 0] - 0.5  # points lie in front of the cameras
        z = np.concatenate([self.points, right], axis=1)
        seen = observations(frame.index, frame.time_ns, self.ids, z, has_right=matched)
        return FrontendOutput(seen, tracked=tracked, matched=int(matched.sum()), detected=len(new))

    def corners(self, image):
        """Return corners (K, 2) away from the tracked points."""
        mask = np.full(image.shape, 255, np.uint8)
        for u, v in self.points.round().astype(int):
            cv2.circle(mask, (int(u), int(v)), 12, 0, -1)
        wanted = max(300 - len(self.points), 1)
        new = cv2.goodFeaturesToTrack(image, wanted, 0.01, 12, mask=mask)
        return np.zeros((0, 2), np.float32) if new is None else new.reshape(-1, 2)


def flow(first, second, points):
    """Return where points of one image are in another (N, 2), and which were found (N,)."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(first, second, points, None, winSize=(21, 21))
    return moved, found.ravel().astype(bool)


if __name__ == "__main__":
    print("checking on 40 rendered frames", flush=True)
    print(check_frontend(CornersAndFlow))
    with tempfile.TemporaryDirectory() as folder:
        if len(sys.argv) < 2:
            print("rendering the street", flush=True)
            from vio.sim.scenarios import write_demo_recording
        source = (
            sys.argv[1] if len(sys.argv) > 1 else str(write_demo_recording(Path(folder) / "street"))
        )
        dataset = open_dataset(source)
        print(f"running on {len(dataset.recording.frame_times_ns)} frames", flush=True)
        parts = Parts(frontend=CornersAndFlow(dataset.recording.camera))
        result = run(dataset, load_config(overrides=["motion=none"]), parts=parts)
        if dataset.recording.reference is not None:
            score = evaluate(
                result.trajectory, dataset.recording.reference, T_cam0_imu=result.T_cam0_body
            )
            print(f"ATE {score.ate_m.rmse:.3f} m over {score.path_length_m:.1f} m")
