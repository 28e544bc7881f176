"""A viewer of one's own: features in the image beside the path, frame by frame, as an animated picture.

python examples/animated_picture.py SOURCE OUT.webp
"""

import sys

import cv2
import numpy as np
from PIL import Image

from vio import load_config, open_dataset, run
from vio.geometry.upright import upright_axes
from vio.view.live import states_of

WIDTH, EVERY, LONGEST = 480, 2, 10  # pixels of each half, frames between two pictures, steps of a feature's tail
COLOURS = np.array([(60, 130, 255), (60, 220, 130), (230, 50, 50), (170, 170, 170), (250, 150, 50)])  # as in `vio view`


class Film:
    """Has `frame(result)` and `close()`, and so can watch any run."""

    def __init__(self, T_cam0_body):
        self.T_body_cam0, self.axes = np.linalg.inv(T_cam0_body), None
        self.path, self.tails, self.pictures = [], {}, []

    def frame(self, result):
        T_world_cam0, seen = result.estimate.T_world_imu @ self.T_body_cam0, result.output.observations
        self.axes = upright_axes(T_world_cam0[None]) if self.axes is None else self.axes
        self.path.append(self.axes @ T_world_cam0[:3, 3])  # right, ahead, up at the start
        features = zip(seen.ids.tolist(), seen.z[:, :2], strict=True)
        self.tails = {name: [*self.tails.get(name, []), pixel][-LONGEST:] for name, pixel in features}
        image = cv2.cvtColor(result.frame.left, cv2.COLOR_GRAY2RGB)
        states = states_of(seen, result.selection.chosen, result.report)
        for tail, colour in zip(self.tails.values(), COLOURS[states].tolist(), strict=True):
            cv2.polylines(image, [np.round(tail).astype(np.int32)], False, colour, 1, cv2.LINE_AA)
            cv2.circle(image, np.round(tail[-1]).astype(int).tolist(), 3, colour, 1, cv2.LINE_AA)
        if len(self.path) % EVERY == 0:
            size = WIDTH, round(image.shape[0] * WIDTH / image.shape[1])
            self.pictures.append(cv2.resize(image, size, interpolation=cv2.INTER_AREA))

    def close(self):  # here the size of the path is known
        height, path = self.pictures[0].shape[0], np.array(self.path)[:, :2]
        low, high = path.min(axis=0) - 1, path.max(axis=0) + 1
        zoom = (np.array([WIDTH, height]) / (high - low)).min()
        places = np.round((path - (low + high) / 2) * zoom * [1, -1] + [WIDTH / 2, height / 2]).astype(np.int32)
        for k, picture in enumerate(self.pictures):
            side, done = np.full((height, WIDTH, 3), 255, np.uint8), places[: (k + 1) * EVERY]
            cv2.polylines(side, [done], False, (31, 95, 191), 2, cv2.LINE_AA)
            cv2.circle(side, done[-1].tolist(), 5, (217, 130, 43), -1, cv2.LINE_AA)
            self.pictures[k] = np.hstack([picture, side])


dataset = open_dataset(sys.argv[1])
film = Film(dataset.recording.T_cam0_body)
run(dataset, load_config(), viewer=film)
first, *others = map(Image.fromarray, film.pictures)
first.save(sys.argv[2], save_all=True, append_images=others, duration=80, loop=0, quality=45, method=6)
print(f"{sys.argv[2]}: {1 + len(others)} pictures")
