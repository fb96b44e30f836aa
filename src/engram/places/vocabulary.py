"""Vocabularies: their training, binary words, statistics and Chow-Liu tree.

A tree of binary words: grown by clustering descriptors, searched to quantise them. Source: Nistér &
Stewénius, Scalable recognition with a vocabulary tree, CVPR 2006, with clusters of binary vectors:
Grana et al., A fast approach for integrating ORB descriptors in the bag of words model, 2013
(k-majority).

The Chow-Liu tree: the strongest dependences between words. Source: Chow & Liu, Approximating
discrete probability distributions with dependence trees, IEEE Transactions on Information Theory
14(3), 1968; used for visual words by Cummins & Newman, FAB-MAP, IJRR 27(6), 2008, §4.3.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
import safetensors
import safetensors.numpy
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import check_bounds
from engram.errors import IncompatibleError, InputError, MapCorruptError
from engram.frontend.features import feature_kind, plain_name
from engram.frontend.frame import DescriptorKind
from engram.monitor import QUIET, Monitor

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, slots=True, eq=False)
class TreeArrays:
    """A tree as it is stored.

    Attributes:
        centres: (M, B) uint8, one per node in breadth-first order; the root's is unused.
        bounds: (M+1,) int32, the children of node n are the nodes bounds[n] to bounds[n + 1] - 1;
            a node without children is a leaf, and leaves are the words, in this order.
    """

    centres: NDArray[np.uint8]
    bounds: NDArray[np.int32]

    @property
    def words(self) -> int:
        """Number of leaves."""
        return int(np.count_nonzero(np.diff(self.bounds) == 0))

    @property
    def leaf_centres(self) -> NDArray[np.uint8]:
        """(W, B) uint8, the centres of the words."""
        return self.centres[np.flatnonzero(np.diff(self.bounds) == 0)]

    def searchable(self) -> _core.WordTree:
        """The tree in the form that the core searches."""
        try:
            return _core.WordTree(self.centres, self.bounds)
        except (TypeError, ValueError) as error:
            raise InputError(str(error)) from error


def grow_tree(
    descriptors: NDArray[np.uint8],
    words: int,
    depth: int,
    *,
    iterations: int,
    seed: int,
    monitor: Monitor = QUIET,
) -> TreeArrays:
    """Clusters descriptors level by level into a tree with one leaf per word.

    All levels but the last have the same branching factor. The last one divides the words in
    proportion to the members of each cluster, so that all words cover about equally many
    descriptors.

    Args:
        descriptors: (N, B) uint8, N > 0.
        words: number of leaves; there are fewer if descriptors are equal or few.
        iterations: most of Lloyd's iterations per cluster.
        monitor: receives the stage `cluster`, one item per cluster.
    """
    branching = round(words ** (1 / depth))
    # Clusters of the level above as rows of their members, in the order of the level.
    clusters = [np.arange(len(descriptors))]
    levels: list[NDArray[np.uint8]] = [np.zeros((1, descriptors.shape[1]), np.uint8)]
    children: list[NDArray[np.int64]] = []
    with monitor.stage("cluster", sum(branching**level for level in range(depth))) as stage:
        for level in range(depth):
            sizes = np.array([len(cluster) for cluster in clusters])
            last = level == depth - 1
            wanted = _shared_out(words, sizes) if last else np.full(len(sizes), branching)
            found: list[NDArray[np.uint8]] = []
            below: list[NDArray[np.int64]] = []
            for cluster, k in zip(clusters, wanted, strict=True):
                centres, parts = _split(descriptors, cluster, int(k), iterations, seed + level)
                found.append(centres)
                below += parts
                stage.advance()
            levels.append(np.concatenate(found))
            children.append(np.array([len(centres) for centres in found]))
            clusters = below
    children.append(np.zeros(len(clusters), np.int64))
    bounds = np.concatenate([[1], 1 + np.cumsum(np.concatenate(children))])
    return TreeArrays(np.concatenate(levels), bounds.astype(np.int32))


def _split(
    descriptors: NDArray[np.uint8],
    cluster: NDArray[np.int64],
    k: int,
    iterations: int,
    seed: int,
) -> tuple[NDArray[np.uint8], list[NDArray[np.int64]]]:
    """Centres (K, B) uint8 of a cluster's parts, and the rows of the members of each.

    A cluster that is not split becomes its own only child, so that all leaves have the same depth.
    """
    centres, part = _core.k_majority(descriptors[cluster], k, iterations, seed)
    order = np.argsort(part, kind="stable")
    ends = np.cumsum(np.bincount(part, minlength=len(centres)))
    return centres.view(np.uint8), np.split(cluster[order], ends[:-1])


def _shared_out(total: int, sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """`total` in proportion to sizes, at least 1 each, by the largest remainder."""
    shares = total * sizes / sizes.sum()
    whole: NDArray[np.int64] = np.maximum(np.floor(shares).astype(np.int64), 1)
    left = total - int(whole.sum())
    if left > 0:
        order = np.argsort(whole - shares, kind="stable")
        whole[order[:left]] += 1
    return whole


# Rows of the mutual information held at a time: 40 MB at 10,000 words.
_BLOCK = 512


@dataclass(frozen=True, slots=True, eq=False)
class WordStatistics:
    """Counts of words in training images, alone and together with their parent in the tree.

    Attributes:
        images: number of training images.
        seen: (W,) int32, images that show each word.
        parents: (W,) int32, parent of each word in the Chow-Liu tree; -1 for a root. Independent
            words are in separate trees.
        seen_with_parent: (W,) int32, images that show both; 0 for a root.
    """

    images: int
    seen: NDArray[np.int32]
    parents: NDArray[np.int32]
    seen_with_parent: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.seen)


def learn_statistics(
    images: list[NDArray[np.int32]], words: int, monitor: Monitor = QUIET
) -> WordStatistics:
    """Counts words and builds the tree of the greatest total mutual information.

    Memory holds one block of rows of the mutual information at a time; of each block only the
    maximum spanning forest is kept. This is exact: an edge that is the weakest of a cycle among
    some edges is the weakest among all.

    Args:
        images: the distinct words, (n,) int32, of each training image.
        monitor: receives the stage `relate`, one item per block of rows.
    """
    from scipy.sparse import csr_array

    shown = _occurrences(images, words)
    seen = np.asarray(shown.sum(axis=0), dtype=np.int32)
    by_word = shown.T.tocsr()
    forest: csr_array = csr_array((words, words))
    blocks = range(0, words, _BLOCK)
    with monitor.stage("relate", len(blocks)) as stage:
        for first in blocks:
            rows = np.arange(first, min(first + _BLOCK, words))
            both = (by_word[rows] @ shown).toarray()
            information = mutual_information(both, seen[rows, None], seen[None, :], len(images))
            information[np.arange(words) <= rows[:, None]] = 0  # each pair once
            forest = _strongest(forest, information, first)
            stage.advance()
    parents = _rooted(forest, seen)
    return WordStatistics(len(images), seen, parents, _with_parent(by_word, parents))


def mutual_information(
    both: NDArray[np.float64], a: NDArray[np.int32], b: NDArray[np.int32], images: int
) -> NDArray[np.float64]:
    """Mutual information of pairs of binary variables, from counts that broadcast.

    Args:
        both: (W, V) float64, counts of images that show both words.
        a, b: (W, 1) and (V,) int32, counts of images that show each of the two words.
        images: number of images.

    Returns:
        (W, V) float64, nats.
    """
    p_a, p_b = a / images, b / images
    p_both = both / images
    joint = (p_both, p_a - p_both, p_b - p_both, 1 - p_a - p_b + p_both)
    apart = (p_a * p_b, p_a * (1 - p_b), (1 - p_a) * p_b, (1 - p_a) * (1 - p_b))
    total = np.zeros(np.broadcast_shapes(both.shape, a.shape, b.shape))
    for p, q in zip(joint, apart, strict=True):
        seen = (p > 0) & (q > 0)
        ratio = np.divide(p, q, out=np.ones_like(total), where=seen)
        total += np.where(seen, p, 0) * np.log(ratio)
    return np.maximum(total, 0)


def _occurrences(images: list[NDArray[np.int32]], words: int) -> csr_array:
    """(images, W) float64, 1 where an image shows a word."""
    from scipy.sparse import csr_array

    lengths = [len(image) for image in images]
    columns = np.concatenate([*images, np.zeros(0, np.int32)])
    starts = np.concatenate([[0], np.cumsum(lengths)])
    return csr_array((np.ones(len(columns)), columns, starts), shape=(len(images), words))


def _strongest(forest: csr_array, information: NDArray[np.float64], first: int) -> csr_array:
    """The maximum spanning forest of a forest and a block of rows from `first` on."""
    from scipy.sparse import coo_array, csr_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    rows, columns = np.nonzero(information)
    old = forest.tocoo()
    words = forest.shape[0]
    weights = np.concatenate([old.data, -information[rows, columns]])
    ends = (np.concatenate([old.row, rows + first]), np.concatenate([old.col, columns]))
    return csr_array(minimum_spanning_tree(coo_array((weights, ends), (words, words)).tocsr()))


def _rooted(forest: csr_array, seen: NDArray[np.int32]) -> NDArray[np.int32]:
    """(W,) int32: parent of each word, if each tree's root is its most frequent word."""
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    words = len(seen)
    parents = np.full(words, -1, np.int32)
    _, tree_of = connected_components(forest, directed=False)
    _, roots = np.unique(tree_of[np.argsort(-seen, kind="stable")], return_index=True)
    by_frequency = np.argsort(-seen, kind="stable")
    edges = forest.tocoo()
    degree = np.bincount(np.concatenate([edges.row, edges.col]), minlength=words)
    for root in by_frequency[roots]:
        if degree[root] == 0:
            continue
        order, before = breadth_first_order(forest, int(root), directed=False)
        parents[order[1:]] = before[order[1:]]
    return parents


def _with_parent(by_word: csr_array, parents: NDArray[np.int32]) -> NDArray[np.int32]:
    """(W,) int32: number of images that show a word and its parent."""
    children = np.flatnonzero(parents >= 0)
    together = np.zeros(len(parents), np.int32)
    if len(children):
        both = by_word[children].multiply(by_word[parents[children]])
        together[children] = np.asarray(both.sum(axis=1)).ravel()
    return together


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
        samples: the words, (n,) int32, of some training images, which represent new places.
        beam: branches followed at a time when searching a descriptor's word. Two find the nearest
            of 10,000 words for 79 % of the descriptors, one for 63 % (simulated drives, world 5).
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
    """Inverse of `encode_vocabulary`, for bytes of any origin."""
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

    For the kinds of this package a small one, trained on simulated drives; for others theirs, or
    `one_word_vocabulary`.
    """
    file = resources.files("engram.places") / "data" / f"{plain_name(descriptor)}.safetensors"
    if file.is_file():
        return decode_vocabulary(file.read_bytes())
    if (added := feature_kind(descriptor).vocabulary) is not None:
        return decode_vocabulary(added.read_bytes())
    return one_word_vocabulary(descriptor)


def one_word_vocabulary(descriptor: DescriptorKind) -> Vocabulary:
    """A vocabulary by which all places look alike."""
    root_and_word = np.zeros((2, feature_kind(descriptor).descriptor_bytes), np.uint8)
    tree = TreeArrays(root_and_word, np.array([1, 2, 2], np.int32))
    once, none = np.ones(1, np.int32), np.zeros(1, np.int32)
    return Vocabulary(descriptor, tree, WordStatistics(2, once, none - 1, none), (), trained_on="–")


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


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """Settings of `train_vocabulary`.

    Attributes:
        depth: levels of the tree. Three find the nearest word more often than four, and as fast.
        iterations: most iterations per cluster; more have no measurable effect.
        descriptors: most descriptors to cluster, drawn evenly from all frames.
        samples: frames that represent new places. Source: Cummins & Newman, IJRR 2008, §4.5:
            sampling estimates the sum over unmapped places.
    """

    words: Annotated[int, Meta(ge=2, le=65_536)] = 10_000
    depth: Annotated[int, Meta(ge=1, le=6)] = 3
    beam: Annotated[int, Meta(ge=1, le=8)] = 2
    iterations: Annotated[int, Meta(ge=1, le=1000)] = 10
    descriptors: Annotated[int, Meta(ge=2, le=100_000_000)] = 1_000_000
    samples: Annotated[int, Meta(ge=1, le=10_000)] = 100
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0

    def __post_init__(self) -> None:
        check_bounds(self)


def train_vocabulary(
    frames: Sequence[NDArray[np.uint8]],
    kind: DescriptorKind,
    config: TrainingConfig | None = None,
    *,
    trained_on: str = "",
    monitor: Monitor = QUIET,
) -> Vocabulary:
    """Clusters descriptors into words and learns which words occur together.

    Equal input and configuration give an equal vocabulary on every machine.

    Args:
        frames: the descriptors of each frame, (N, B) uint8. The frames should show distinct
            places, like a random sample of where robots drive, as words are counted per frame.
        trained_on: description stored in the vocabulary, for people.
        monitor: receives the stages `cluster`, `quantise` and `relate`.
    """
    config = config or TrainingConfig()
    total = sum(len(frame) for frame in frames)
    if total < config.words:
        raise InputError(
            f"{len(frames)} frames have {total} descriptors, too few for {config.words} words; "
            "give more drives or fewer words"
        )
    rng = np.random.default_rng(config.seed)
    rows = np.concatenate(frames)
    if total > config.descriptors:
        rows = rows[np.sort(rng.choice(total, config.descriptors, replace=False))]
    tree = grow_tree(
        rows,
        config.words,
        config.depth,
        iterations=config.iterations,
        seed=config.seed,
        monitor=monitor,
    )
    search = tree.searchable()
    images = []
    with monitor.stage("quantise", len(frames)) as stage:
        for frame in frames:
            images.append(np.unique(search.quantise(frame, config.beam)))
            stage.advance()
    statistics = learn_statistics(images, tree.words, monitor)
    usable = [at for at, image in enumerate(images) if len(image)]
    drawn = rng.choice(usable, min(config.samples, len(usable)), replace=False)
    samples = tuple(images[at] for at in np.sort(drawn))
    return Vocabulary(kind, tree, statistics, samples, config.beam, trained_on)
