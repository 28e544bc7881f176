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
        self.rows_px = 1.5  # left and right rows of a rectified pair agree
        self.left, self.ids, self.points, self.next_id = (
            None,
            np.zeros(0, int),
            np.zeros((0, 2), np.float32),
            0,
        )

    def process(self, frame, prior=None):
        """Return ids and pixels [ul vl ur vr] of a rectified pair."""
        if self.left is not None and len(self.points):
            moved, found, _ = cv2.calcOpticalFlowPyrLK(
                self.left, frame.left, self.points, None, winSize=(21, 21)
            )
            back, returned, _ = cv2.calcOpticalFlowPyrLK(
                frame.left, self.left, moved, None, winSize=(21, 21)
            )
            keep = (found & returned).ravel().astype(bool) & (
                np.linalg.norm(back - self.points, axis=1) < 0.5
            )
            self.points, self.ids = moved[keep], self.ids[keep]
        mask = np.full(frame.left.shape, 255, np.uint8)
        for u, v in self.points.round().astype(int):
            cv2.circle(mask, (int(u), int(v)), 12, 0, -1)
        new = cv2.goodFeaturesToTrack(
            frame.left, max(300 - len(self.points), 1), 0.01, 12, mask=mask
        )
        new = np.zeros((0, 2), np.float32) if new is None else new.reshape(-1, 2)
        tracked, self.points = (
            len(self.points),
            np.concatenate([self.points, new]).astype(np.float32),
        )
        self.ids = np.concatenate([self.ids, self.next_id + np.arange(len(new))])
        self.next_id, self.left = self.next_id + len(new), frame.left
        right, found, _ = cv2.calcOpticalFlowPyrLK(
            frame.left, frame.right, self.points, None, winSize=(21, 21)
        )
        matched = found.ravel().astype(bool) & (np.abs(right - self.points)[:, 1] < self.rows_px)
        matched &= right[:, 0] < self.points[:, 0] - 0.5  # points lie in front of the cameras
        z = np.concatenate([self.points, right], axis=1)
        seen = observations(frame.index, frame.time_ns, self.ids, z, has_right=matched)
        return FrontendOutput(seen, tracked=tracked, matched=int(matched.sum()), detected=len(new))


if __name__ == "__main__":
    print(check_frontend(CornersAndFlow))
    with tempfile.TemporaryDirectory() as folder:
        if len(sys.argv) < 2:
            from vio.sim.scenarios import write_demo_recording
        source = (
            sys.argv[1] if len(sys.argv) > 1 else str(write_demo_recording(Path(folder) / "street"))
        )
        dataset = open_dataset(source)
        parts = Parts(frontend=CornersAndFlow(dataset.recording.camera))
        result = run(dataset, load_config(overrides=["motion=none"]), parts=parts)
        if dataset.recording.reference is not None:
            score = evaluate(
                result.trajectory, dataset.recording.reference, T_cam0_imu=result.T_cam0_body
            )
            print(f"ATE {score.ate_m.rmse:.3f} m over {score.path_length_m:.1f} m")
