"""Which keyframes look like a new one: a bag of words whose words are some bits of the descriptors.

A word is `_BITS` chosen bits of a descriptor, in each of `_TABLES` independent choices
(locality-sensitive hashing, Indyk & Motwani 1998). Two descriptors of one point that differ in d of
256 bits share the word of one table with probability (1 - d / 256)^_BITS: 0.2 for d = 28, 0.6 with
four tables. Nothing is trained, so that the words of two maps are the same, and a map's first
keyframe can be found as well as its last one. Rare words weigh more (tf-idf, Sivic & Zisserman
2003).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from vio.geometry.lie import FloatArray
from vio.mapping.features import DESCRIPTOR_BYTES, Bits
from vio.numerics.compiled import compiled
from vio.numerics.kinds import Capacity, Tolerance
from vio.records import BoolArray, IntArray

Words = npt.NDArray[np.uint16]
Owners = npt.NDArray[np.unsignedinteger[Any]]


class _WordRules(NamedTuple):
    """How words are made of descriptors."""

    tables: int = 4  # 4 x 16384 words; a keyframe of 600 features has 2400 of them in 5 kB
    bits: int = 14
    seed: int = 20120617  # of the choice of bits: any, but the same in all maps


_WORD_RULES = _WordRules()
_WORDS = 1 << _WORD_RULES.bits
# keyframes before and after a candidate whose scores are added to its own: they show the same place
_NEIGHBOURS = 2


class _TailRules(NamedTuple):
    """Keyframes that are compared without the index."""

    # keyframes; a merge takes as long as the comparison with ten times as many, and scores are
    # the same
    min_keyframes: Capacity[int] = 32
    share: Capacity[float] = 1 / 16


_TAIL = _TailRules()
# of the weights, which are integers: a score is right to a hundred thousandth
_UNIT: Tolerance[int] = 1 << 16
SEGMENT: Capacity[int] = 256  # keyframes whose words a file keeps in the order of the index


def words_of(descriptors: Bits) -> Words:
    """Return the words (T, N) of descriptors (N, 32), one row a table."""
    out = np.zeros((_WORD_RULES.tables, len(descriptors)), dtype=np.uint16)
    _write_words(np.ascontiguousarray(descriptors), _chosen_bits(), out)
    return out


@cache
def _chosen_bits() -> IntArray:
    """Return the bits (T, B) of each table's words."""
    chosen = np.random.default_rng(_WORD_RULES.seed).permutation(8 * DESCRIPTOR_BYTES)[
        : _WORD_RULES.tables * _WORD_RULES.bits
    ]
    return chosen.reshape(_WORD_RULES.tables, _WORD_RULES.bits).astype(np.int64)


@dataclass(frozen=True, slots=True)
class Segment:
    """The words of `SEGMENT` keyframes that follow one another, inverted."""

    begins: npt.NDArray[np.uint32]  # (T, W + 1) of each word among the owners
    owners: npt.NDArray[np.uint8]  # (T, N) keyframes, ordered by word and then by number

    @classmethod
    def of(cls, begins: npt.NDArray[np.uint32], owners: npt.NDArray[np.uint8]) -> Segment:
        """Make a segment of the flat arrays of a file.

        Raises:
            ValueError: they are not those of an index.
        """
        begins = begins.reshape(_WORD_RULES.tables, _WORDS + 1)
        owners = owners.reshape(_WORD_RULES.tables, -1)
        ends = begins[:, [0, -1]] == (0, owners.shape[1])
        if not ends.all() or (begins[:, 1:] < begins[:, :-1]).any():
            raise ValueError("its words are not in order")
        return cls(begins, owners)


class PlaceIndex:
    """The words of all keyframes, in the order in which they were added.

    An inverted index: for each word the keyframes that show it. The newest keyframes are a tail
    whose words are compared one by one, until it is long enough to be merged into the index.
    Weights are integers, so that a score does not depend on where a keyframe is.
    """

    def __init__(self) -> None:
        # of each word among the owners
        self._begins: IntArray = np.zeros((_WORD_RULES.tables, _WORDS + 1), dtype=np.int64)
        self._owners: Owners = np.zeros(
            (_WORD_RULES.tables, 0), dtype=np.uint16
        )  # keyframes, ordered by word
        self._merged = 0  # keyframes in the index; the others are the tail
        self._tail: list[Words] = []
        self._sizes: list[int] = []  # features of each keyframe
        # keyframe that showed a word last, from 1
        self._newest: IntArray = np.zeros((_WORD_RULES.tables, _WORDS), dtype=np.int64)
        # keyframes with a word
        self._frequency: IntArray = np.zeros((_WORD_RULES.tables, _WORDS), dtype=np.int64)
        self._unsaved: list[Words] = []  # of the keyframes since the last full segment

    def __len__(self) -> int:
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
        self._unsaved.append(words)
        self._sizes.append(words.shape[1])
        _count_words(words, self._newest, len(self._sizes), self._frequency)
        if len(self._tail) >= max(_TAIL.min_keyframes, int(_TAIL.share * len(self))):
            self._merge()

    def restore(self, segments: Sequence[Segment]) -> None:
        """Take the first keyframes of a map from its file, into an empty index."""
        if not segments:
            return
        begins = np.array([s.begins for s in segments])
        owners, offsets = _joined([s.owners for s in segments])
        self._merged = len(segments) * SEGMENT
        self._owners = self._room(owners.shape[1])
        _join_segments(
            begins, owners, offsets, self._begins, self._owners, self._newest, self._frequency
        )
        for segment in segments:
            self._sizes += np.bincount(segment.owners[0], minlength=SEGMENT).tolist()

    def full_segment(self) -> Segment | None:
        """Return the words of the newest keyframes once there are `SEGMENT` of them; they are
        then forgotten here.
        """
        if len(self._unsaved) < SEGMENT:
            return None
        words, offsets = _joined(self._unsaved)
        begins = np.zeros_like(self._begins)
        owners = np.empty(words.shape, dtype=np.uint16)
        nothing = np.zeros((_WORD_RULES.tables, 0), dtype=np.uint16)
        _merge_words(
            np.zeros_like(begins), nothing, words, offsets, int(np.int64(0)), begins, owners
        )
        self._unsaved = []
        return Segment(begins.astype(np.uint32), owners.astype(np.uint8))

    def _room(self, size: int) -> Owners:
        count = max(len(self), self._merged)
        if count > np.iinfo(np.uint16).max:
            kind = np.min_scalar_type(count)
        else:
            kind = np.dtype(np.uint16)
        return np.empty((_WORD_RULES.tables, size), dtype=kind)

    def _merge(self) -> None:
        words, offsets = _joined(self._tail)
        owners = self._room(self._owners.shape[1] + words.shape[1])
        begins = np.zeros_like(self._begins)
        _merge_words(self._begins, self._owners, words, offsets, self._merged, begins, owners)
        self._begins = begins
        self._owners = owners
        self._merged = len(self)
        self._tail = []

    def scores(self, descriptors: Bits) -> FloatArray:
        """Return for each keyframe (K,) the weight of the words that it shares with descriptors
        (N, 32).
        """
        count = len(self)
        weight = np.zeros((_WORD_RULES.tables, _WORDS), dtype=np.int64)
        known = [np.unique(row).astype(np.int64) for row in words_of(descriptors)]
        for table, row in enumerate(known):
            logs = np.log((count + 1.0) / (self._frequency[table, row] + 1.0))
            weight[table, row] = np.rint(_UNIT * logs).astype(np.int64)
        out = np.zeros(count, dtype=np.int64)
        for table, row in enumerate(known):
            _add_owners(self._begins[table], self._owners[table], row, weight[table], out)
        _add_weights(*_joined(self._tail), weight, out[self._merged :])
        return out / (_UNIT * np.sqrt(np.maximum(self._sizes, 1.0)))

    def candidates(self, descriptors: Bits, allowed: BoolArray, most: int) -> IntArray:
        """Return up to `most` keyframes among those `allowed` (K,), the most similar first, each
        of another place.
        """
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
            # those that share its sum
            left[max(middle - 2 * _NEIGHBOURS, 0) : middle + 2 * _NEIGHBOURS + 1] = 0.0
        return np.array(out, dtype=np.int64)


def _joined(parts: Sequence[npt.NDArray[Any]]) -> tuple[npt.NDArray[Any], IntArray]:
    """Return the words or owners (T, N) of all parts, and where those of each begin (K + 1,)."""
    nothing = np.zeros((_WORD_RULES.tables, 0), dtype=np.uint16)
    return np.concatenate(parts or [nothing], axis=1), np.cumsum(
        [0, *(part.shape[1] for part in parts)]
    )


@compiled
def _join_segments(
    begins: npt.NDArray[np.uint32],
    owners: npt.NDArray[np.uint8],
    offsets: IntArray,
    out_begins: IntArray,
    out_owners: Owners,
    newest: IntArray,
    frequency: IntArray,
) -> None:
    """Write the index of segments that follow one another, word by word, and count the keyframes
    with each.

    Those of segment s begin at `offsets[s]` of the owners (T, N), and there at `begins[s]` (T, W +
    1).
    """
    for t in range(len(owners)):
        n = 0
        for w in range(newest.shape[1]):
            for s in range(len(begins)):
                for e in range(offsets[s] + begins[s, t, w], offsets[s] + begins[s, t, w + 1]):
                    number = s * SEGMENT + owners[t, e]
                    out_owners[t, n] = number
                    n += 1
                    if newest[t, w] != number + 1:
                        newest[t, w] = number + 1
                        frequency[t, w] += 1
            out_begins[t, w + 1] = n


@compiled
def _write_words(descriptors: Bits, chosen: IntArray, out: Words) -> None:
    """Write the words (T, N) of descriptors (N, 32): bits (T, B), the highest of a byte being
    its first.
    """
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
    """Merge the words (T, N) of keyframes from `first` on into an index; those of keyframe k
    begin at `offsets[k]`.
    """
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
def _add_owners(
    begins: IntArray, owners: Owners, known: IntArray, weight: IntArray, out: IntArray
) -> None:
    """Add the weight of each word in `known` to its owners in `out` (K,), once for each feature
    with it.
    """
    for w in known:
        for e in range(begins[w], begins[w + 1]):
            out[owners[e]] += weight[w]


@compiled
def _add_weights(words: Words, offsets: IntArray, weight: IntArray, out: IntArray) -> None:
    """Add the weights of the words (T, N) of each keyframe to `out` (K,); those of keyframe k
    begin at `offsets[k]`.
    """
    for k in range(len(out)):
        total = 0
        for n in range(offsets[k], offsets[k + 1]):
            for t in range(len(words)):
                total += weight[t, words[t, n]]
        out[k] += total
