"""Which keyframes look like a new one: a bag of words whose words are some bits of the descriptors.

A word is `_BITS` chosen bits of a descriptor, in each of `_TABLES` independent choices (locality-sensitive hashing,
Indyk & Motwani 1998). Two descriptors of one point that differ in d of 256 bits share the word of one table with
probability (1 - d / 256)^_BITS: 0.2 for d = 28, 0.6 with four tables. Nothing is trained, so that the words of two maps
are the same, and a map's first keyframe can be found as well as its last one. Rare words weigh more (tf-idf, Sivic &
Zisserman 2003).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from vio.compiled import compiled
from vio.geometry.lie import FloatArray
from vio.mapping.features import DESCRIPTOR_BYTES, Bits
from vio.records import BoolArray, IntArray

Words = npt.NDArray[np.uint16]

_TABLES, _BITS = 4, 14  # 4 x 16384 words; a keyframe of 600 features has 2400 of them in 5 kB
_SEED = 20120617  # of the choice of bits: any, but the same in all maps
_NEIGHBOURS = 2  # keyframes before and after a candidate whose scores are added to its own: they show the same place
_GROW = 1.5


def words_of(descriptors: Bits) -> Words:
    """Return the words (T, N) of descriptors (N, 32), one row a table."""
    bits = np.unpackbits(np.ascontiguousarray(descriptors), axis=1)
    chosen = np.random.default_rng(_SEED).permutation(8 * DESCRIPTOR_BYTES)[: _TABLES * _BITS].reshape(_TABLES, _BITS)
    value = 1 << np.arange(_BITS)
    return np.stack([(bits[:, columns] @ value).astype(np.uint16) for columns in chosen])


class PlaceIndex:
    """The words of all keyframes, in the order in which they were added."""

    def __init__(self) -> None:
        self._words: Words = np.zeros((_TABLES, 0), dtype=np.uint16)
        self._offsets: list[int] = [0]
        self._frequency: IntArray = np.zeros((_TABLES, 1 << _BITS), dtype=np.int64)  # keyframes with a word

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self._offsets) - 1

    @property
    def nbytes(self) -> int:
        """Memory of the words, bytes."""
        return self._words.nbytes + self._frequency.nbytes

    def add(self, descriptors: Bits) -> None:
        """Add a keyframe with these descriptors (N, 32)."""
        words = words_of(descriptors)
        end = self._offsets[-1] + words.shape[1]
        if end > self._words.shape[1]:
            grown = np.zeros((_TABLES, int(_GROW * end) + 1024), dtype=np.uint16)
            grown[:, : self._words.shape[1]] = self._words
            self._words = grown
        self._words[:, self._offsets[-1] : end] = words
        self._offsets.append(end)
        for table, row in enumerate(words):
            self._frequency[table, np.unique(row)] += 1

    def scores(self, descriptors: Bits) -> FloatArray:
        """Return for each keyframe (K,) the weight of the words that it shares with descriptors (N, 32)."""
        count = len(self)
        weight = np.zeros((_TABLES, 1 << _BITS), dtype=np.float32)
        for table, row in enumerate(words_of(descriptors)):
            known = np.unique(row)
            weight[table, known] = np.log((count + 1.0) / (self._frequency[table, known] + 1.0))
        out = np.zeros(count)
        _add_weights(self._words, np.array(self._offsets), weight, out)
        return out

    def candidates(self, descriptors: Bits, allowed: BoolArray, most: int) -> IntArray:
        """Return up to `most` keyframes among those `allowed` (K,), the most similar first, each of another place."""
        if not len(self) or not len(descriptors):
            return np.zeros(0, dtype=np.int64)
        score = np.where(allowed, self.scores(descriptors), 0.0)
        kernel = np.ones(2 * _NEIGHBOURS + 1)
        around = np.convolve(score, kernel)[_NEIGHBOURS : _NEIGHBOURS + len(score)]
        out: list[int] = []
        left = np.where(score > 0, around, 0.0)
        while len(out) < most and left.max() > 0:
            middle = int(np.argmax(left))
            near = slice(max(middle - _NEIGHBOURS, 0), middle + _NEIGHBOURS + 1)
            out.append(near.start + int(np.argmax(score[near])))
            left[max(middle - 2 * _NEIGHBOURS, 0) : middle + 2 * _NEIGHBOURS + 1] = 0.0  # those that share its sum
        return np.array(out, dtype=np.int64)


@compiled
def _add_weights(words: Words, offsets: IntArray, weight: npt.NDArray[np.float32], out: FloatArray) -> None:
    """Add the weights of each keyframe's words to `out` (K,), divided by the square root of its number of words."""
    for k in range(len(out)):
        total = 0.0
        for n in range(offsets[k], offsets[k + 1]):
            for t in range(len(words)):
                total += weight[t, words[t, n]]
        out[k] = total / max(float(offsets[k + 1] - offsets[k]), 1.0) ** 0.5
