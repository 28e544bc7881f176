"""Which keyframes look like a new one: a bag of words whose words are some bits of the descriptors.

A word is `_BITS` chosen bits of a descriptor, in each of `_TABLES` independent choices (locality-sensitive hashing,
Indyk & Motwani 1998). Two descriptors of one point that differ in d of 256 bits share the word of one table with
probability (1 - d / 256)^_BITS: 0.2 for d = 28, 0.6 with four tables. Nothing is trained, so that the words of two maps
are the same, and a map's first keyframe can be found as well as its last one. Rare words weigh more (tf-idf, Sivic &
Zisserman 2003).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray
from vio.mapping.features import DESCRIPTOR_BYTES, Bits
from vio.numerics.compiled import compiled
from vio.records import BoolArray, IntArray

Words = npt.NDArray[np.uint16]
Owners = npt.NDArray[np.unsignedinteger[Any]]

_TABLES, _BITS = 4, 14  # 4 x 16384 words; a keyframe of 600 features has 2400 of them in 5 kB
_WORDS = 1 << _BITS
_SEED = 20120617  # of the choice of bits: any, but the same in all maps
_NEIGHBOURS = 2  # keyframes before and after a candidate whose scores are added to its own: they show the same place
_LEAST_TAIL, _TAIL_SHARE = 32, 1 / 16  # keyframes; a merge takes as long as the comparison with ten times as many
_UNIT = 1 << 16  # of the weights


def words_of(descriptors: Bits) -> Words:
    """Return the words (T, N) of descriptors (N, 32), one row a table."""
    out = np.zeros((_TABLES, len(descriptors)), dtype=np.uint16)
    _write_words(np.ascontiguousarray(descriptors), _chosen_bits(), out)
    return out


@cache
def _chosen_bits() -> IntArray:
    """Return the bits (T, B) of each table's words."""
    chosen = np.random.default_rng(_SEED).permutation(8 * DESCRIPTOR_BYTES)[: _TABLES * _BITS]
    return chosen.reshape(_TABLES, _BITS).astype(np.int64)


class PlaceIndex:
    """The words of all keyframes, in the order in which they were added.

    An inverted index: for each word the keyframes that show it. The newest keyframes are a tail whose words are
    compared one by one, until it is long enough to be merged into the index. Weights are integers, so that a score does
    not depend on where a keyframe is.
    """

    def __init__(self) -> None:
        self._begins: IntArray = np.zeros((_TABLES, _WORDS + 1), dtype=np.int64)  # of each word among the owners
        self._owners: Owners = np.zeros((_TABLES, 0), dtype=np.uint16)  # keyframes, ordered by word
        self._merged = 0  # keyframes in the index; the others are the tail
        self._tail: list[Words] = []
        self._sizes: list[int] = []  # features of each keyframe
        self._newest: IntArray = np.zeros((_TABLES, _WORDS), dtype=np.int64)  # keyframe that showed a word last, from 1
        self._frequency: IntArray = np.zeros((_TABLES, _WORDS), dtype=np.int64)  # keyframes with a word

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self._sizes)

    @property
    def nbytes(self) -> int:
        """Memory of the words, bytes."""
        arrays = (self._begins, self._owners, self._frequency, *self._tail)
        return sum(array.nbytes for array in arrays)

    def add(self, descriptors: Bits) -> None:
        """Add a keyframe with these descriptors (N, 32)."""
        words = words_of(descriptors)
        self._tail.append(words)
        self._sizes.append(words.shape[1])
        _count_words(words, self._newest, len(self._sizes), self._frequency)
        if len(self._tail) >= max(_LEAST_TAIL, int(_TAIL_SHARE * len(self))):
            self._merge()

    def _merge(self) -> None:
        words, offsets = self._joined_tail()
        kind = np.min_scalar_type(len(self)) if len(self) > np.iinfo(np.uint16).max else np.dtype(np.uint16)
        owners: Owners = np.empty((_TABLES, self._owners.shape[1] + words.shape[1]), dtype=kind)
        begins = np.zeros_like(self._begins)
        _merge_words(self._begins, self._owners, words, offsets, self._merged, begins, owners)
        self._begins, self._owners, self._merged, self._tail = begins, owners, len(self), []

    def _joined_tail(self) -> tuple[Words, IntArray]:
        words = np.concatenate([np.zeros((_TABLES, 0), dtype=np.uint16), *self._tail], axis=1)
        return words, np.cumsum([0, *(row.shape[1] for row in self._tail)])

    def scores(self, descriptors: Bits) -> FloatArray:
        """Return for each keyframe (K,) the weight of the words that it shares with descriptors (N, 32)."""
        count = len(self)
        weight = np.zeros((_TABLES, _WORDS), dtype=np.int64)
        known = [np.unique(row).astype(np.int64) for row in words_of(descriptors)]
        for table, row in enumerate(known):
            logs = np.log((count + 1.0) / (self._frequency[table, row] + 1.0))
            weight[table, row] = np.rint(_UNIT * logs).astype(np.int64)
        out = np.zeros(count, dtype=np.int64)
        for table, row in enumerate(known):
            _add_owners(self._begins[table], self._owners[table], row, weight[table], out)
        _add_weights(*self._joined_tail(), weight, out[self._merged :])
        return out / (_UNIT * np.sqrt(np.maximum(self._sizes, 1.0)))

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
def _write_words(descriptors: Bits, chosen: IntArray, out: Words) -> None:
    """Write the words (T, N) of descriptors (N, 32): bits (T, B), the highest of a byte being its first."""
    for t in range(len(chosen)):
        for n in range(len(descriptors)):
            word = 0
            for j in range(chosen.shape[1]):
                bit = chosen[t, j]
                word |= ((descriptors[n, bit >> 3] >> (7 - (bit & 7))) & 1) << j
            out[t, n] = word


@compiled
def _count_words(words: Words, newest: IntArray, number: int, frequency: IntArray) -> None:
    """Count a keyframe's words (T, N) in `frequency` (T, W), each once."""
    for t in range(len(words)):
        for n in range(words.shape[1]):
            w = words[t, n]
            if newest[t, w] != number:
                newest[t, w] = number
                frequency[t, w] += 1


@compiled
def _merge_words(
    begins: IntArray,
    owners: Owners,
    words: Words,
    offsets: IntArray,
    first: int,
    out_begins: IntArray,
    out_owners: Owners,
) -> None:
    """Merge the words (T, N) of keyframes from `first` on into an index; those of keyframe k begin at `offsets[k]`."""
    cursor = np.empty(begins.shape[1], dtype=np.int64)
    for t in range(len(words)):
        for w in range(begins.shape[1] - 1):
            out_begins[t, w + 1] = begins[t, w + 1] - begins[t, w]
        for n in range(words.shape[1]):
            out_begins[t, words[t, n] + 1] += 1
        for w in range(begins.shape[1] - 1):
            out_begins[t, w + 1] += out_begins[t, w]
            cursor[w] = out_begins[t, w]
            for e in range(begins[t, w], begins[t, w + 1]):
                out_owners[t, cursor[w]] = owners[t, e]
                cursor[w] += 1
        for k in range(len(offsets) - 1):
            for n in range(offsets[k], offsets[k + 1]):
                w = words[t, n]
                out_owners[t, cursor[w]] = first + k
                cursor[w] += 1


@compiled
def _add_owners(begins: IntArray, owners: Owners, known: IntArray, weight: IntArray, out: IntArray) -> None:
    """Add the weight of each word in `known` to its owners in `out` (K,), once for each feature with it."""
    for w in known:
        for e in range(begins[w], begins[w + 1]):
            out[owners[e]] += weight[w]


@compiled
def _add_weights(words: Words, offsets: IntArray, weight: IntArray, out: IntArray) -> None:
    """Add the weights of the words (T, N) of each keyframe to `out` (K,); those of keyframe k begin at `offsets[k]`."""
    for k in range(len(out)):
        total = 0
        for n in range(offsets[k], offsets[k + 1]):
            for t in range(len(words)):
                total += weight[t, words[t, n]]
        out[k] += total
