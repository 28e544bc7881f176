#!/usr/bin/env bash
# OpenCV 5.0.0: a FileStorage writes a vector as a tag of its own, `!!opencv-nd-matrix` with `sizes`, under %YAML 1.2, and
# returns it as (3,); 4.14.0 writes `!!opencv-matrix` of 3 rows and returns (3, 1). Matrices are written as before.
# Guessed: one form for all arrays.
# Matters here: calibration files of the new version need the second tag; T of a pair is a vector in some of them.
# Source: cv2.FileStorage; this run.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cat > "$folder/try.py" <<'PYTHON'
import tempfile
from pathlib import Path

import cv2
import numpy as np

path = str(Path(tempfile.mkdtemp()) / "a.yaml")
store = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
store.write("T", np.array([1.0, 2.0, 3.0]))
store.write("R", np.eye(3))
store.release()
text = Path(path).read_text()
store = cv2.FileStorage(path, cv2.FILE_STORAGE_READ)
shape = store.getNode("T").mat().shape
print("OpenCV", cv2.__version__, "T is read as", shape)
print(text)
assert text.count("!!opencv-matrix") == (1 if cv2.__version__.startswith("5") else 2)
assert ("!!opencv-nd-matrix" in text) == cv2.__version__.startswith("5")
assert shape == ((3,) if cv2.__version__.startswith("5") else (3, 1))
PYTHON
for version in 4.14.0.94 5.0.0.93; do
    python3 -m pip --quiet --disable-pip-version-check install --target "$folder/$version" numpy==2.4.6 "opencv-python-headless==$version"
    PYTHONPATH="$folder/$version" python3 "$folder/try.py"
done
