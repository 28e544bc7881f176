"""Which of two names is the left camera's: `left right`, `cam0 cam1`, `img_l img_r` and others."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from functools import partial
from itertools import combinations

# what may differ between the names of a pair, left first; in small letters, numbers as numbers
_SIDES = (
    ("left", "right"),
    ("l", "r"),
    ("lcam", "rcam"),
    ("port", "starboard"),
    ("0", "1"),
    ("1", "2"),
    ("2", "3"),
    ("a", "b"),
)
_CAMERAS = ("cam", "camera", "infra", "infrared", "fisheye")  # whose number tells them apart
_COUNTED = (("0", "1"), ("1", "2"))  # how cameras are numbered, left first
_IMAGES = ("image", "img")  # likewise, where a number of the frame follows
_WORDS = re.compile(r"\d+|[A-Z]?[a-z]+|[A-Z]+(?![a-z])|/|\\")


def words_of(name: str) -> tuple[str, ...]:
    """Return the words and numbers of a name in small letters, numbers without leading zeros."""
    return tuple(
        str(int(word)) if word.isdigit() else word.lower() for word in _WORDS.findall(name)
    )


def is_pair(left: str, right: str) -> bool:
    """Return whether two names differ in their side alone, and the first one is the left one."""
    a = words_of(left)
    b = words_of(right)
    if len(a) != len(b):
        return False
    differing = {(x, y) for x, y in zip(a, b, strict=True) if x != y}
    return len(differing) == 1 and next(iter(differing)) in _SIDES


def pairs_of(names: list[str]) -> list[tuple[str, str]]:
    """Return all pairs among names, left first."""
    found = []
    for a, b in combinations(names, 2):
        if is_pair(a, b):
            found.append((a, b))
        elif is_pair(b, a):
            found.append((b, a))
    return found


def first_pair(pairs: list[tuple[str, str]]) -> tuple[str, str] | None:
    """Return the only pair that is named as left and right, else the only one that is numbered 0
    and 1, else the only one; None: it is not clear, as of cameras 1, 2 and 3, or of three folders
    000, 001 and 002, which are as well parts of one camera's images.
    """
    bare = [pair for pair in pairs if all(word.isdigit() for word in words_of(pair[0]))]
    if len(bare) > 1:
        pairs = [pair for pair in pairs if pair not in bare]
    named = [pair for pair in pairs if side_word(pair[0]) == "left"]
    zero = [pair for pair in pairs if "0" in _differing(*pair)]
    best = named or zero or pairs
    return best[0] if len(best) == 1 else None


def _differing(left: str, right: str) -> set[str]:
    return {a for a, b in zip(words_of(left), words_of(right), strict=True) if a != b}


def split_sides(names: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """Return the names of left and right images that lie in one folder, in pairs.

    None: they are not of two cameras. A word for a side tells them apart, or the number of a
    camera (`frame01_cam0`); those of one side without the other are left out.
    """
    for numbers in _COUNTED:
        frames: dict[tuple[str, ...], dict[str, str]] = {}
        for name in names:
            found = _frame_and_side(name, numbers)
            if found is None or found[1] in frames.setdefault(found[0], {}):
                break
            frames[found[0]][found[1]] = name
        else:
            return _in_pairs(frames, len(names))
    return None


def _in_pairs(
    frames: dict[tuple[str, ...], dict[str, str]], count: int
) -> tuple[list[str], list[str]] | None:
    """Return the left and the right names of the frames that have both; None: they are few of
    all.
    """
    pairs = [sides for sides in frames.values() if len(sides) == 2]
    alone = count - 2 * len(pairs)
    if not pairs or alone > len(pairs):
        return None
    return [pair["left"] for pair in pairs], [pair["right"] for pair in pairs]


def split_depths(names: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """Return the names of images and of their depth images that lie in one folder, in pairs
    (`frame000017`, `depth000017`); None: they are not of both, or one of a right camera is there.
    """
    if not any("depth" in name.lower() for name in names):  # as of 100,000 images of one camera
        return None
    images: dict[tuple[str, ...], str] = {}
    depths: dict[tuple[str, ...], str] = {}
    for name in names:
        words = words_of(os.path.splitext(name)[0])
        frame = tuple(word for word in words if word.isdigit())
        kind = depths if "depth" in words else images
        if frame in kind or side_word(name) == "right":
            return None
        kind[frame] = name
    both = [frame for frame in images if frame in depths]
    if not both or 2 * len(both) < len(images):
        return None
    return [images[frame] for frame in both], [depths[frame] for frame in both]


def stamped_sides(names: Sequence[str]) -> tuple[list[str], list[str]] | None:
    """Return the names of left and right images that lie in one folder, where each has a word for
    its side and a time or number of its own (`front_left_0_1600000000250000000`); None: some have
    none, one side has less than half of the other, or one begins when the other has ended, as turns
    to the left and to the right of one camera do.
    """
    sides: dict[str, list[str]] = {"left": [], "right": []}
    counts: dict[str, list[tuple[int, ...]]] = {"left": [], "right": []}
    for name in names:
        found = _frame_and_side(name, ())
        if found is None:
            return None
        frame, side = found
        sides[side].append(name)
        counts[side].append(tuple(int(word) for word in frame if word.isdigit()))
    fewest, most = sorted(map(len, sides.values()))
    if not fewest or 2 * fewest < most:
        return None
    if max(map(min, counts.values())) > min(map(max, counts.values())):
        return None
    return sides["left"], sides["right"]


def frame_words(stem: str) -> tuple[str, ...] | str:
    """Return the words of an image's name without the side that one of them states, also as a part
    of it (`000003_leftImg8bit`); the name where none does.
    """
    found = _frame_and_side(stem, ())
    return stem if found is None else found[0]


def _frame_and_side(name: str, numbers: tuple[str, ...]) -> tuple[tuple[str, ...], str] | None:
    """Return the words of an image's name but the first that names a side, and this side.

    A word does before the number of a camera, which may be that of a stereo camera
    (`img_CAMERA1_17_left`).

    Args:
        name: of the image.
        numbers: of the left and the right camera; none: words alone tell.
    """
    words = words_of(os.path.splitext(name)[0])
    for side_at in (_side_of_word, partial(_side_of_camera, numbers=numbers)):
        for k in range(len(words)):
            side = side_at(words, k)
            if side is not None:
                return (*words[:k], "", *words[k + 1 :]), side
    return None


def _side_of_word(words: tuple[str, ...], k: int) -> str | None:
    """Return the side that a word of a name states; None: it states none."""
    for left, right in _SIDES[:3]:
        if words[k] in (left, right):
            return "left" if words[k] == left else "right"
    return None


def _side_of_camera(words: tuple[str, ...], k: int, numbers: tuple[str, ...]) -> str | None:
    """Return the side that the number of a camera in a name states; None: it states none."""
    if not k or words[k] not in numbers:
        return None
    counted = words[k + 1 : k + 2] and words[k + 1].isdigit()  # image_0_17: camera, number
    if words[k - 1] in _CAMERAS or (counted and words[k - 1] in _IMAGES):
        return "left" if words[k] == numbers[0] else "right"
    return None


def side_word(name: str) -> str | None:
    """Return the word of a name that states a side, as `left` or `right`; None: none does."""
    words = words_of(name)
    for left, right in _SIDES[:2]:
        if left in words:
            return "left"
        if right in words:
            return "right"
    return None


def without_side(stem: str) -> str:
    """Return an image's name without the part that names its camera: `000012_cam0` as `000012`.

    Names that hold nothing else stay what they are.
    """
    bare = _CAMERA_PART.sub("", stem)
    return bare if re.search(r"\d", bare) else stem


# of an image's name, at its beginning or end, or between separators
_CAMERA_PART = re.compile(
    r"(?:(?<=^)|(?<=[_\-. ]))(?:(?:cam(?:era)?|image|img|infra|fisheye)[_\-]?\d{1,2}|left|right|l|r)(?=$|[_\-. ])",
    re.IGNORECASE,
)
