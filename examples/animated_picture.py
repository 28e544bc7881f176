"""A viewer of one's own: features in the image beside the path over ground truth, as an animated
picture.

python examples/animated_picture.py SOURCE OUT.webp [EVERY]        # every 2nd frame
"""

import sys

import cv2
import numpy as np
from PIL import Image

from vio import evaluate, load_config, open_dataset, run
from vio.view.live import states_of

WIDTH = 480  # pixels of each half
LONGEST = 10  # steps of a feature's tail
# as in `vio view`
COLOURS = np.array([(60, 130, 255), (60, 220, 130), (230, 50, 50), (170, 170, 170), (250, 150, 50)])


class Film:  # has `frame(result)` and `close()`, and so can watch any run
    def __init__(self):
        self.tails = {}
        self.pictures = []

    def frame(self, result):
        seen = result.output.observations
        self.tails = {
            i: [*self.tails.get(i, []), z[:2]][-LONGEST:]
            for i, z in zip(seen.ids, seen.z, strict=True)
        }
        image = cv2.cvtColor(result.frame.left, cv2.COLOR_GRAY2RGB)
        states = states_of(seen, result.selection.chosen, result.report)
        for tail, colour in zip(self.tails.values(), COLOURS[states].tolist(), strict=True):
            cv2.polylines(image, [np.round(tail).astype(np.int32)], False, colour, 1, cv2.LINE_AA)
            cv2.circle(image, np.round(tail[-1]).astype(int).tolist(), 3, colour, 1, cv2.LINE_AA)
        zoom = WIDTH / image.shape[1]
        self.pictures.append(
            cv2.resize(image, None, fx=zoom, fy=zoom, interpolation=cv2.INTER_AREA)
        )

    def close(self): ...


dataset = open_dataset(sys.argv[1])
film = Film()
every = int(sys.argv[3]) if len(sys.argv) > 3 else 2
print(f"running on {len(dataset.recording.frame_times_ns)} frames", flush=True)
result = run(dataset, load_config(), viewer=film)
score = evaluate(result.trajectory, dataset.recording.reference, T_cam0_imu=result.T_cam0_body)
truth = score.reference.positions
path = score.aligned.positions
# in which the path extends furthest
plane = np.linalg.svd(truth - truth.mean(axis=0), full_matrices=False)[2][:2].T
low = (truth @ plane).min(axis=0)
high = (truth @ plane).max(axis=0)
size = np.array([WIDTH, film.pictures[0].shape[0]])
zoom = ((size - 60) / (high - low)).min()  # pixels a metre
truth, path = (
    np.round(zoom * (p @ plane - (low + high) / 2) + size / 2 - [0, 10]).astype(int)
    for p in (truth, path)
)
bar_m = 10.0 ** np.floor(np.log10(0.4 * WIDTH / zoom))
bottom = int(size[1]) - 10
legend = f"{bar_m:g} m    gray: ground truth, blue: estimate"
for k in range(0, len(film.pictures), every):
    side = np.full_like(film.pictures[k], 255)
    done = path[: np.searchsorted(score.rows, k) + 1]
    cv2.polylines(side, [truth], False, (190, 190, 190), 5, cv2.LINE_AA)
    cv2.polylines(side, [done], False, (31, 95, 191), 2, cv2.LINE_AA)
    cv2.circle(side, done[-1].tolist(), 5, (217, 130, 43), -1, cv2.LINE_AA)
    cv2.line(side, (12, bottom), (12 + round(bar_m * zoom), bottom), (0, 0, 0), 2)
    cv2.putText(
        side, legend, (12, bottom - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA
    )
    film.pictures[k] = np.hstack([film.pictures[k], side])
first, *others = map(Image.fromarray, film.pictures[::every])
first.save(
    sys.argv[2], save_all=True, append_images=others, duration=80, loop=0, quality=45, method=6
)
print(
    f"{sys.argv[2]}: {1 + len(others)} pictures, ATE {score.ate_m.rmse:.4f} m over "
    f"{score.path_length_m:.0f} m"
)
