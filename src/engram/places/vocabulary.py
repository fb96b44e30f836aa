"""The vocabulary: binary words, their statistics, and their encoding."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Annotated, Any

import msgspec
import numpy as np
import safetensors
import safetensors.numpy
from numpy.typing import NDArray

from engram import _core
from engram.errors import IncompatibleError, InputError, MapCorruptError
from engram.frontend import DescriptorKind, feature_kind
from engram.frontend.features import plain_name
from engram.places.chow_liu import WordStatistics
from engram.places.tree import TreeArrays

VOCABULARY_FORMAT = 1
_METADATA_KEY = "engram.vocabulary"
_MOST_WORDS = 1 << 16
_SHAPES: dict[str, tuple[str, int]] = {  # dtype and number of dimensions
    "centres": ("U8", 2),
    "bounds": ("I32", 1),
    "seen": ("I32", 1),
    "parents": ("I32", 1),
    "seen_with_parent": ("I32", 1),
    "sample_words": ("U16", 1),
    "sample_lengths": ("I32", 1),
}
_DTYPES: dict[str, np.dtype[Any]] = {
    "U8": np.dtype("u1"),
    "U16": np.dtype("<u2"),
    "I32": np.dtype("<i4"),
}


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """Words of one kind of descriptor.

    Attributes:
        descriptor: kind of the words.
        tree: the words, and the search tree over them.
        statistics: how often words occur, alone and together.
        samples: the words, (n,) int32, of some training images, which represent new places.
        beam: branches followed at a time when searching a descriptor's word. Two find the nearest
            word clearly more often than one (`lab/reports/constants.md`).
        trained_on: description of the training data.
    """

    descriptor: DescriptorKind
    tree: TreeArrays
    statistics: WordStatistics
    samples: tuple[NDArray[np.int32], ...]
    beam: int = 2
    trained_on: str = ""
    _search: _core.WordTree = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_search", self.tree.searchable())

    def __len__(self) -> int:
        return len(self.statistics)

    def quantise(self, descriptors: NDArray[np.uint8]) -> NDArray[np.int32]:
        """(N,) int32: the word of each descriptor, (N, B) uint8."""
        return self._search.quantise(descriptors, self.beam)

    def words_of(self, descriptors: NDArray[np.uint8], kind: DescriptorKind) -> NDArray[np.int32]:
        """The distinct words of an image, (n,) int32, increasing.

        Args:
            descriptors: (N, B) uint8, possibly none.
            kind: kind of the descriptors.

        Raises:
            IncompatibleError: the vocabulary has another kind.
        """
        if kind != self.descriptor:
            raise IncompatibleError(
                f"these are {kind} descriptors, the words are of {self.descriptor}: make the drive "
                "again from its images with engram record DRIVE LOG --features "
                f"{plain_name(self.descriptor)}, or use a vocabulary of {plain_name(kind)}"
            )
        return np.unique(self.quantise(np.ascontiguousarray(descriptors)))


def encode_vocabulary(vocabulary: Vocabulary) -> bytes:
    """The vocabulary as a safetensors file; equal vocabularies give equal bytes."""
    statistics = vocabulary.statistics
    samples = vocabulary.samples
    arrays = {
        "centres": vocabulary.tree.centres,
        "bounds": vocabulary.tree.bounds,
        "seen": statistics.seen,
        "parents": statistics.parents,
        "seen_with_parent": statistics.seen_with_parent,
        "sample_words": np.concatenate([*samples, np.zeros(0, np.int32)]),
        "sample_lengths": np.array([len(sample) for sample in samples], np.int32),
    }
    about = {
        "format": VOCABULARY_FORMAT,
        "descriptor": str(vocabulary.descriptor),
        "images": statistics.images,
        "beam": vocabulary.beam,
        "trained_on": vocabulary.trained_on,
    }
    contiguous = {
        name: np.ascontiguousarray(array, _DTYPES[_SHAPES[name][0]])
        for name, array in arrays.items()
    }
    # A single entry: several have no defined order, and equal content must give equal bytes.
    metadata = {_METADATA_KEY: json.dumps(about, sort_keys=True)}
    return bytes(safetensors.numpy.save(contiguous, metadata))


def vocabulary_hash(body: bytes) -> bytes:
    """16-byte hash of an encoded vocabulary: truncated SHA-256."""
    return hashlib.sha256(body).digest()[:16]


def hash_of(vocabulary: Vocabulary) -> bytes:
    """`vocabulary_hash` of a decoded vocabulary."""
    return vocabulary_hash(encode_vocabulary(vocabulary))


class _About(msgspec.Struct):
    """Metadata of a vocabulary, in addition to its arrays."""

    format: int
    descriptor: str
    images: Annotated[int, msgspec.Meta(ge=1, lt=2**31)]
    beam: Annotated[int, msgspec.Meta(ge=1, lt=2**31)]
    trained_on: str


# What malformed headers raise; of nested ones JSON raises the last.
_MALFORMED = (
    safetensors.SafetensorError,
    msgspec.MsgspecError,
    InputError,
    ValueError,
    LookupError,
    TypeError,
    RecursionError,
)


def decode_vocabulary(body: bytes) -> Vocabulary:
    """Inverse of `encode_vocabulary`, for bytes of any origin.

    Raises:
        MapCorruptError: they are not a vocabulary of a known format, or hold invalid values.
    """
    try:
        tensors = safetensors.deserialize(body)  # type: ignore[no-untyped-call]  # as it comes
        about = _metadata(body)
        arrays = _checked_arrays(tensors)
        return _assembled(about, arrays)
    except _MALFORMED as error:
        raise MapCorruptError(f"not a usable vocabulary: {error}") from error


@cache
def default_vocabulary(descriptor: DescriptorKind) -> Vocabulary:
    """The vocabulary of a map that has none of its own.

    For the kinds of this package a small one, trained on simulated drives; for others
    `one_word_vocabulary`.

    Raises:
        IncompatibleError: the kind is unknown.
    """
    file = resources.files("engram.places") / "data" / f"{plain_name(descriptor)}.safetensors"
    if file.is_file():
        return decode_vocabulary(file.read_bytes())
    return one_word_vocabulary(descriptor)


def one_word_vocabulary(descriptor: DescriptorKind) -> Vocabulary:
    """A vocabulary by which all places look alike.

    Raises:
        IncompatibleError: the kind is unknown.
    """
    root_and_word = np.zeros((2, feature_kind(descriptor).descriptor_bytes), np.uint8)
    tree = TreeArrays(root_and_word, np.array([1, 2, 2], np.int32))
    one, none = np.ones(1, np.int32), np.zeros(1, np.int32)
    return Vocabulary(descriptor, tree, WordStatistics(2, one, none - 1, none), (), trained_on="–")


def _metadata(body: bytes) -> _About:
    length = int.from_bytes(body[:8], "little")
    header = json.loads(body[8 : 8 + length])
    about = msgspec.json.decode(header["__metadata__"][_METADATA_KEY], type=_About)
    if about.format != VOCABULARY_FORMAT:
        raise ValueError(f"its format is {about.format}, must be {VOCABULARY_FORMAT}")
    return about


def _checked_arrays(tensors: Any) -> dict[str, NDArray[Any]]:
    found: dict[str, NDArray[Any]] = {}
    for name, tensor in tensors:
        dtype, dimensions = _SHAPES[name]
        if tensor["dtype"] != dtype or len(tensor["shape"]) != dimensions:
            raise ValueError(f"{name} is {tensor['dtype']} {tensor['shape']}")
        flat = np.frombuffer(tensor["data"], _DTYPES[dtype])
        found[name] = flat.reshape(tensor["shape"])
    if found.keys() != _SHAPES.keys():
        raise ValueError(f"missing arrays: {', '.join(sorted(_SHAPES.keys() - found.keys()))}")
    return found


def _assembled(about: _About, arrays: dict[str, NDArray[Any]]) -> Vocabulary:
    statistics = WordStatistics(
        about.images, arrays["seen"], arrays["parents"], arrays["seen_with_parent"]
    )
    _check_statistics(statistics)
    lengths, words = arrays["sample_lengths"], arrays["sample_words"].astype(np.int32)
    if (lengths < 0).any() or int(lengths.sum(dtype=np.int64)) != len(words):
        raise ValueError("its samples do not fit their lengths")
    samples = tuple(np.split(words, np.cumsum(lengths)[:-1])) if len(lengths) else ()
    for sample in samples:
        if len(sample) and sample[-1] >= len(statistics):
            raise ValueError("a sample shows an unknown word")
        if (np.diff(sample) <= 0).any():
            raise ValueError("the words of a sample do not increase")
    kind = feature_kind(about.descriptor)
    if arrays["centres"].shape[1] != kind.descriptor_bytes:
        raise ValueError(
            f"its words have {arrays['centres'].shape[1]} bytes, descriptors of kind {kind.name} "
            f"{kind.descriptor_bytes}"
        )
    vocabulary = Vocabulary(
        kind.name,
        TreeArrays(arrays["centres"], arrays["bounds"]),
        statistics,
        samples,
        about.beam,
        about.trained_on,
    )
    if vocabulary.tree.words != len(statistics):
        raise ValueError("its tree and its statistics have different numbers of words")
    vocabulary.quantise(arrays["centres"][:1])  # refuses a beam that is out of range
    return vocabulary


def _check_statistics(statistics: WordStatistics) -> None:
    """Checks that the counts are consistent and the forest has no cycle."""
    words, parents = len(statistics), statistics.parents
    if not 0 < words <= _MOST_WORDS:
        raise ValueError(f"it has {words} words, must be 1 to {_MOST_WORDS}")
    if len(parents) != words or len(statistics.seen_with_parent) != words:
        raise ValueError("its counts are not one per word")
    if (parents < -1).any() or (parents >= words).any():
        raise ValueError("a word's parent is not a word")
    children = np.flatnonzero(parents >= 0)
    together = statistics.seen_with_parent
    most = np.minimum(statistics.seen[children], statistics.seen[parents[children]])
    if (
        statistics.images < 1
        or (statistics.seen < 0).any()
        or (statistics.seen > statistics.images).any()
        or (together < 0).any()
        or (together[children] > most).any()
    ):
        raise ValueError("its counts contradict each other")
    ancestors = parents.copy()
    for _ in range(words.bit_length() + 1):  # each round doubles the distance to the ancestor
        ancestors = np.where(ancestors >= 0, ancestors[ancestors], -1)
    if (ancestors >= 0).any():
        raise ValueError("its tree of words has a cycle")
