"""Signatures: one binary descriptor of a whole image, pooled from those of its landmarks.

Each landmark belongs to the nearest of a few centres and to a column of the image. For every centre
and column, a bit of the signature says whether that bit is set more often there than it usually is
in descriptors near that centre: VLAD, its residuals rounded to a bit, all in whole numbers.

Source: Jégou et al., Aggregating local descriptors into a compact image representation, CVPR 2010.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load

from engram import _core
from engram.errors import IncompatibleError
from engram.frontend import DescriptorKind, Frame
from engram.frontend.features import plain_name
from engram.places.recogniser import Comparison, Recognition
from engram.places.vocabulary import Vocabulary

Signature = NDArray[np.int32]

# Shares of set bits are stored in units of this.
SHARE = 65535
_COLUMNS = 3
# Stands where nothing was seen: a place and an image that both lack a part agree in half of it,
# as by chance.
_PLACE_LACKS, _IMAGE_LACKS = 0b01010101, 0b00110011


class Signatures:
    """A `PlaceRecogniser` by the bits that signatures have in common. It reports no new places.

    Args:
        vocabulary: of a kind that has signatures.

    Raises:
        IncompatibleError: the kind has none, or they are of another model.
    """

    name = "signature"

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._kind = vocabulary.descriptor
        arrays = _arrays(self._kind)
        self._centres, self._shares = arrays["centres"], arrays["shares"].astype(np.int64)
        self._bytes = self._centres.shape[1]
        self._places = np.zeros((16, self.bytes_per_place), np.uint8)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    @property
    def bytes_per_place(self) -> int:
        """Memory of a place."""
        return _COLUMNS * int(self._centres.size)

    def signature(self, frame: Frame) -> Signature:
        """(n,) int32: what a frame shows, for `add`, `compare` and `recognise`.

        Raises:
            IncompatibleError: its landmarks are of another kind.
        """
        if frame.descriptor != self._kind:
            raise IncompatibleError(
                f"a frame of kind {frame.descriptor} has no signature of kind {self._kind}: "
                f"record the drive with --features {plain_name(self._kind)}"
            )
        pixels = frame.landmarks.pixels
        descriptors = np.ascontiguousarray(frame.landmarks.descriptors[:, : self._bytes])
        parts = len(self._centres) * _COLUMNS
        signature = np.full((parts, self._bytes), _IMAGE_LACKS, np.uint8)
        if len(descriptors):
            nearest = _core.hamming_matrix(descriptors, self._centres).argmin(1)
            column = np.clip(pixels[:, 0] * _COLUMNS / frame.camera.width, 0, _COLUMNS - 1)
            part = column.astype(np.int64) * len(self._centres) + nearest
            members = members_of(part, parts)
            # Whole numbers up to the number of landmarks: single precision sums them exactly.
            bits = np.unpackbits(descriptors, axis=1).astype(np.float32)
            found = (members.astype(np.float32) @ bits).astype(np.int64)
            count = members.sum(1)
            more = found * SHARE > np.tile(self._shares, (_COLUMNS, 1)) * count[:, None]
            seen = count > 0
            signature[seen] = np.packbits(more[seen], axis=1)
        return signature.ravel().view(np.int32)

    def add(self, words: Signature) -> int:
        """See `PlaceRecogniser`; takes a signature."""
        if self._count == len(self._places):
            more = np.zeros((max(16, self._count // 8), self.bytes_per_place), np.uint8)
            self._places = np.concatenate([self._places, more])
        parts = self._parts(words)
        lacks = (parts == _IMAGE_LACKS).all(1)
        self._places[self._count] = np.where(lacks[:, None], _PLACE_LACKS, parts).ravel()
        self._count += 1
        return self._count - 1

    def similarities(self, words: Signature) -> NDArray[np.float64]:
        """(P,) float64: share of bits, 0…1, that an image and each place have in common."""
        own = np.ascontiguousarray(self._parts(words).reshape(1, -1))
        different = _core.hamming_matrix(own, self._places[: self._count])[0]
        agreement: NDArray[np.float64] = 1.0 - different / (8.0 * self.bytes_per_place)
        return agreement

    def _parts(self, words: Signature) -> NDArray[np.uint8]:
        """A signature's parts (P, B); all marked missing for an image without a signature."""
        if not len(words):
            return np.full((_COLUMNS * len(self._centres), self._bytes), _IMAGE_LACKS, np.uint8)
        return words.view(np.uint8).reshape(-1, self._bytes)

    def compare(self, words: Signature) -> Comparison:
        """See `PlaceRecogniser`; takes a signature."""
        return Comparison(self.similarities(words), None)

    def recognise(self, words: Signature, count: int) -> Recognition:
        """See `PlaceRecogniser`; takes a signature."""
        agreement = self.similarities(words)
        best = _core.best_scores(agreement, count)
        return Recognition(best, agreement[best], None)


def members_of(parts: NDArray[Any], count: int) -> NDArray[np.int64]:
    """(count, N) int64: 1 where a row belongs to a part."""
    members: NDArray[np.int64] = (np.arange(count)[:, None] == parts[None]).astype(np.int64)
    return members


@cache
def _arrays(kind: DescriptorKind) -> Mapping[str, NDArray[Any]]:
    """Centres (C, B) uint8 and the usual shares of their bits (C, 8·B) uint16."""
    file = resources.files("engram.places") / "data" / f"{plain_name(kind)}.signature.safetensors"
    if not file.is_file():
        raise IncompatibleError(
            f"features of kind {plain_name(kind)} have no signatures; use --relocaliser fabmap"
        )
    arrays = load(file.read_bytes())
    model = bytes(arrays["model"]).decode()
    if model != kind:
        raise IncompatibleError(
            f"the installed signatures are of {model}, the landmarks of {kind}: "
            "install Engram again, or use --relocaliser fabmap"
        )
    return arrays
