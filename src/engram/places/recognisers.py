"""Place recognisers: FAB-MAP 2.0, and signatures of whole images.

Another package adds one by an entry point of the group `engram.recognisers` that names its class.

Signatures: one binary descriptor of a whole image, pooled from those of its landmarks. Each
landmark belongs to the nearest of a few centres and to a column of the image. For every centre and
column, a bit of the signature says whether that bit is set more often there than it usually is in
descriptors near that centre: VLAD, its residuals rounded to a bit, all in whole numbers.

Source: Jégou et al., Aggregating local descriptors into a compact image representation, CVPR 2010.

FAB-MAP 2.0 with an inverted index: exact likelihoods at the cost of the seen words only. log p(Z |
L) is a sum over all words, most of which neither the image nor the place shows. The sum for an
image without words is computed once, when a place is added. A query corrects it for the words that
it shows and for their children in the tree, by an inverted index of the places that show them. The
result is exact.

Source: Cummins & Newman, FAB-MAP, IJRR 27(6), 2008; Appearance-only SLAM at large scale with
FAB-MAP 2.0, IJRR 30(9), 2011, §4.

FAB-MAP's observation model: the likelihood of seeing or missing a word at a place. Source: Cummins
& Newman, FAB-MAP, IJRR 27(6), 2008, §4.2 to §4.4 (here [C08]); Appearance-only SLAM at large scale
with FAB-MAP 2.0, IJRR 30(9), 2011 (here [C11]).
"""

from __future__ import annotations

import builtins
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load

from engram import _core
from engram.errors import ConfigError, IncompatibleError
from engram.frontend.features import plain_name
from engram.frontend.frame import DescriptorKind, Frame
from engram.places.vocabulary import (
    Vocabulary,
    WordStatistics,
)
from engram.plugins import PluginGroup


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """Places that an image may show: a ranking to be verified, not a localisation.

    Attributes:
        places: (K,) int64, numbers of the most likely places, best first; ties by number.
        scores: (K,) float64, their posterior probabilities; similarities, 0…1, from a recogniser
            without probabilities.
        new_place: probability that the image shows none of the places; None if unknown.
    """

    places: NDArray[np.int64]
    scores: NDArray[np.float64]
    new_place: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """How well an image fits each place.

    Attributes:
        evidence: (P,) float64, log-likelihoods relative to those of other images at the place;
            similarities, 0…1, from a recogniser without probabilities. Each is independent of the
            other places.
    """

    evidence: NDArray[np.float64]
    new_place: float | None


class PlaceRecogniser(Protocol):
    """Recognises places, each the set of words of one image, in other images."""

    @property
    def name(self) -> str:
        """Its key in `RECOGNISERS`."""
        ...

    def __len__(self) -> int:
        """Number of places."""
        ...

    def add(self, words: NDArray[np.int32]) -> int:
        """Adds a place.

        Args:
            words: (n,) int32, its distinct words, increasing; possibly none.

        Returns:
            Its number: 0, 1, 2, ….
        """
        ...

    def compare(self, words: NDArray[np.int32]) -> Comparison:
        """How well an image fits each place.

        Args:
            words: (n,) int32, its distinct words, increasing; possibly none.
        """
        ...

    def recognise(self, words: NDArray[np.int32], count: int) -> Recognition:
        """The up to `count` most likely places.

        Args:
            words: (n,) int32, the distinct words of the image, increasing; possibly none.
        """
        ...


@runtime_checkable
class ReadsFrames(Protocol):
    """A `PlaceRecogniser` that compares something else of images than their words."""

    def signature(self, frame: Frame) -> NDArray[np.int32]:
        """(n,) int32: what `add`, `compare` and `recognise` take for an image instead of words."""
        ...


# Places of a block that maps store.
PLACES_PER_BLOCK = _core.PLACES_PER_BLOCK


@dataclass(frozen=True, slots=True, eq=False)
class PlaceBlock:
    """`PLACES_PER_BLOCK` successive places of a recogniser, as maps store them.

    Attributes:
        body: what a query reads.
        numbers: (k, PLACES_PER_BLOCK) float64, log-likelihoods: what stays in memory.
    """

    body: bytes
    numbers: NDArray[np.float64]


# Gives the body of a stored block by its number; None where it is damaged.
ReadBlock: TypeAlias = Callable[[int], bytes | None]


@runtime_checkable
class StoresBlocks(Protocol):
    """A `PlaceRecogniser` whose full blocks can lie in a file instead of in memory."""

    @property
    def stored_as(self) -> str:
        """Names the content of its blocks; another model has another name."""
        ...

    @property
    def rows_of_numbers(self) -> int:
        """Rows k of `PlaceBlock.numbers`."""
        ...

    def open_blocks(self, numbers: NDArray[np.float64], read: ReadBlock) -> None:
        """Begins with stored blocks as its first places; called before any `add`.

        Args:
            numbers: (k, P) float64, log-likelihoods, of all blocks, P a multiple of
                `PLACES_PER_BLOCK`.
            read: called by each query.
        """
        ...

    def block(self, number: int) -> PlaceBlock:
        """A full block that was added, not opened."""
        ...


class _Growing:
    """(k, P) float64: numbers of places in rows, of which there are ever more.

    Args:
        rows: k.
    """

    def __init__(self, rows: int) -> None:
        self._columns = np.zeros((rows, 16))
        self.count = 0

    @property
    def nbytes(self) -> int:
        return self._columns.nbytes

    def __getitem__(self, row: int) -> NDArray[np.float64]:
        return self._columns[row, : self.count]

    def start(self, numbers: NDArray[np.float64]) -> None:
        self._columns, self.count = numbers, numbers.shape[1]

    def append(self, numbers: Sequence[float]) -> None:
        if self.count == self._columns.shape[1]:
            room = np.zeros((len(self._columns), max(16, self.count // 8)))
            self._columns = np.concatenate([self._columns, room], axis=1)
        self._columns[:, self.count] = numbers
        self.count += 1

    def block(self, number: int) -> NDArray[np.float64]:
        first = number * PLACES_PER_BLOCK
        return self._columns[:, first : first + PLACES_PER_BLOCK].copy()


def inverse_frequencies(statistics: WordStatistics) -> NDArray[np.float64]:
    """(W,) float64: log inverse document frequency of each word, a weight."""
    return np.asarray(np.log((statistics.images + 1) / (statistics.seen + 0.5)))


Signature = NDArray[np.int32]

# Shares of set bits are stored in units of this.
SHARE = 65535
_COLUMNS = 3
# Stands where nothing was seen: a place and an image that both lack a part agree in half of it,
# as by chance.
_PLACE_LACKS, _IMAGE_LACKS = 0b01010101, 0b00110011


class Signatures:
    """A `PlaceRecogniser` by the bits that signatures have in common. It reports no new places."""

    name = "signature"
    rows_of_numbers = 0

    def __init__(self, vocabulary: Vocabulary) -> None:
        self._kind = vocabulary.descriptor
        arrays = _arrays(self._kind)
        self._centres, self._shares = arrays["centres"], arrays["shares"].astype(np.int64)
        self._bytes = self._centres.shape[1]
        self._places = np.zeros((16, self.bytes_per_place), np.uint8)
        self._count = self._blocks = 0
        self._read: ReadBlock = lambda _: None

    def __len__(self) -> int:
        return self._blocks * PLACES_PER_BLOCK + self._count

    @property
    def stored_as(self) -> str:
        """See `StoresBlocks`."""
        return f"{self.name} {self._kind}"

    def open_blocks(self, numbers: NDArray[np.float64], read: ReadBlock) -> None:
        """See `StoresBlocks`."""
        self._blocks, self._read = numbers.shape[1] // PLACES_PER_BLOCK, read

    def block(self, number: int) -> PlaceBlock:
        """See `StoresBlocks`."""
        first = (number - self._blocks) * PLACES_PER_BLOCK
        body = self._places[first : first + PLACES_PER_BLOCK].tobytes()
        return PlaceBlock(body, np.zeros((0, PLACES_PER_BLOCK)))

    @property
    def bytes_per_place(self) -> int:
        """Memory of a place."""
        return _COLUMNS * int(self._centres.size)

    def signature(self, frame: Frame) -> Signature:
        """(n,) int32: what a frame shows, for `add`, `compare` and `recognise`."""
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
        return len(self) - 1

    def similarities(self, words: Signature) -> NDArray[np.float64]:
        """(P,) float64: share of bits, 0…1, that an image and each place have in common."""
        own = np.ascontiguousarray(self._parts(words).reshape(1, -1))
        different = [
            *(_core.hamming_matrix(own, self._stored(block))[0] for block in range(self._blocks)),
            _core.hamming_matrix(own, self._places[: self._count])[0],
        ]
        agreement: NDArray[np.float64]
        agreement = 1.0 - np.concatenate(different) / (8.0 * self.bytes_per_place)
        return agreement

    def _stored(self, block: int) -> NDArray[np.uint8]:
        """(PLACES_PER_BLOCK, bytes) uint8: the places of a stored block."""
        body = self._read(block)
        if body is None or len(body) != PLACES_PER_BLOCK * self.bytes_per_place:
            return np.full((PLACES_PER_BLOCK, self.bytes_per_place), _PLACE_LACKS, np.uint8)
        return np.frombuffer(body, np.uint8).reshape(PLACES_PER_BLOCK, -1)

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


_FABMAP = "use --set drive.relocaliser=fabmap, or merge.relocaliser=fabmap for a merge"


@cache
def _arrays(kind: DescriptorKind) -> Mapping[str, NDArray[Any]]:
    """Centres (C, B) uint8 and the usual shares of their bits (C, 8·B) uint16."""
    file = resources.files("engram.places") / "data" / f"{plain_name(kind)}.signature.safetensors"
    if not file.is_file():
        raise IncompatibleError(
            f"features of kind {plain_name(kind)} have no signatures; {_FABMAP}"
        )
    arrays = load(file.read_bytes())
    model = bytes(arrays["model"]).decode()
    if model != kind:
        raise IncompatibleError(
            f"the installed signatures are of {model}, the landmarks of {kind}: "
            f"install Engram again, or {_FABMAP}"
        )
    return arrays


# Bound of beliefs away from 0 and 1: a word without training data must not decide.
_LEAST_BELIEF = 1e-6
_MOST_BELIEF = 1 - 1e-3


@dataclass(frozen=True, slots=True)
class DetectorModel:
    """Detection rates of the front-end.

    Attributes:
        hit: p(z = 1 | e = 1), probability of seeing a word that exists. Source: [C08] §5.
        false_alarm: p(z = 1 | e = 0), probability of seeing one that does not. Source: [C08] §5.
    """

    hit: float = 0.39
    false_alarm: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.false_alarm < self.hit < 1:
            raise ConfigError(
                f"detector: needs 0 <= false_alarm < hit < 1, not {self.false_alarm} and {self.hit}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class ObservationModel:
    """log p(z_q | z_parent, place) for all words and all cases.

    Attributes:
        parents: (W,) int32, -1 for a root, which has equal columns for both values of z_parent.
        log_p: (2, 4, W) float64, log-probabilities: [whether the place shows the word][2 z +
            z_parent].
    """

    parents: NDArray[np.int32]
    log_p: NDArray[np.float64]

    @staticmethod
    def of(
        statistics: WordStatistics, detector: DetectorModel, *, naive: bool = False
    ) -> ObservationModel:
        """The model of a vocabulary."""
        parents = np.full_like(statistics.parents, -1) if naive else statistics.parents
        p_seen, p_given_parent = _probabilities(statistics)
        sight = np.array(  # [e][z]
            [
                [1 - detector.false_alarm, detector.false_alarm],
                [1 - detector.hit, detector.hit],
            ]
        )
        belief = place_beliefs(p_seen, detector)
        log_p = np.empty((2, 4, len(parents)))
        for shown in (0, 1):
            for z in (0, 1):
                for z_parent in (0, 1):
                    given = [
                        _given_existence(p_seen, p_given_parent[z_parent], sight[e], z, parents)
                        for e in (0, 1)
                    ]
                    there = belief[shown]
                    mixed = given[1] * there + given[0] * (1 - there)
                    log_p[shown, 2 * z + z_parent] = np.log(mixed)
        return ObservationModel(parents, log_p)


def place_beliefs(p_seen: NDArray[np.float64], detector: DetectorModel) -> NDArray[np.float64]:
    """(2, W) float64: p(e_q = 1 | place), row 0 for places not showing the word, row 1 for others.

    Bayes' rule for one image of the place. The prior is the share of places with the word that
    explains how often it is seen.

    Args:
        p_seen: (W,) float64, probability p(z_q = 1).

    Source: [C08] §4.4.
    """
    span = detector.hit - detector.false_alarm
    prior = np.clip((p_seen - detector.false_alarm) / span, _LEAST_BELIEF, _MOST_BELIEF)
    beliefs = []
    for there, absent in (
        (1 - detector.hit, 1 - detector.false_alarm),
        (detector.hit, detector.false_alarm),
    ):
        beliefs.append(there * prior / (there * prior + absent * (1 - prior)))
    return np.clip(np.stack(beliefs), _LEAST_BELIEF, _MOST_BELIEF)


def _probabilities(
    statistics: WordStatistics,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """p(z_q = 1), (W,), and p(z_q = 1 | z_parent), (2, W); equal for a root.

    Smoothed by half an image with and half an image without the word; the conditional ones by one
    image with the unconditional probability.
    """
    images, seen = statistics.images, statistics.seen
    p_seen = (seen + 0.5) / (images + 1)
    parents = statistics.parents
    parent_seen = np.where(parents >= 0, seen[parents], 0)
    both = statistics.seen_with_parent
    without = (seen - both + p_seen) / (images - parent_seen + 1)
    together = (both + p_seen) / (parent_seen + 1)
    given = np.stack([without, together])
    return p_seen, np.where(parents >= 0, given, p_seen)


def _given_existence(
    p_seen: NDArray[np.float64],
    p_given_parent: NDArray[np.float64],
    sight: NDArray[np.float64],
    z: int,
    parents: NDArray[np.int32],
) -> NDArray[np.float64]:
    """(W,) float64: p(z_q | e_q, z_parent) = (1 + α/β)⁻¹.

    Args:
        p_seen: (W,) float64, probability p(z_q = 1).
        p_given_parent: (W,) float64, p(z_q = 1 | z_parent).
        sight: (2,) float64, p(z = 0 | e) and p(z = 1 | e) for the given existence e.
        parents: (W,) int32; for roots, -1, only the detector counts.

    Source: [C08] §4.3.
    """
    p_z = p_seen if z else 1 - p_seen
    p_z_given_parent = p_given_parent if z else 1 - p_given_parent
    alpha = p_z * sight[1 - z] * (1 - p_z_given_parent)
    beta = (1 - p_z) * sight[z] * p_z_given_parent
    given: NDArray[np.float64] = np.where(parents >= 0, beta / (alpha + beta), sight[z])
    return given


@dataclass(frozen=True, slots=True)
class FabMapConfig:
    """Settings of FAB-MAP.

    Attributes:
        new_place_prior: prior probability that an image shows none of the places: a lost robot is
            as likely to be somewhere new.
    """

    detector: DetectorModel = field(default_factory=DetectorModel)
    new_place_prior: float = 0.5
    naive_bayes: bool = False

    def __post_init__(self) -> None:
        if not 0 < self.new_place_prior < 1:
            raise ConfigError(
                f"fabmap: new_place_prior is {self.new_place_prior}, must be between 0 and 1"
            )


class FabMap:
    """A `PlaceRecogniser` that gives probabilities, including that of a new place.

    Args:
        vocabulary: words, their statistics, and samples of places outside the map.
    """

    name = "fabmap"
    rows_of_numbers = 2

    def __init__(self, vocabulary: Vocabulary, config: FabMapConfig | None = None) -> None:
        self.config = config or FabMapConfig()
        model = ObservationModel.of(
            vocabulary.statistics, self.config.detector, naive=self.config.naive_bayes
        )
        self._query = _QueryWeights(model)
        self._gain_unseen = model.log_p[1, 0] - model.log_p[0, 0]
        self._places = _Postings(len(vocabulary))
        # Of an image without words at each place, and of the usual image.
        self._numbers = _Growing(self.rows_of_numbers)
        self._elsewhere = _Postings(len(vocabulary))
        self._elsewhere_base = np.array([self._base(sample) for sample in vocabulary.samples])
        for sample in vocabulary.samples:
            self._elsewhere.add(sample)
        self._usual, self._usual_weights = self._of_samples(vocabulary)

    def __len__(self) -> int:
        return self._numbers.count

    @property
    def bytes_per_place(self) -> float:
        """Memory per place, without the vocabulary and what lies in a file."""
        return (self._places.bytes + self._numbers.nbytes) / max(len(self), 1)

    @property
    def stored_as(self) -> str:
        """See `StoresBlocks`."""
        return f"{self.name} {hashlib.sha256(repr(self.config).encode()).hexdigest()[:8]}"

    def open_blocks(self, numbers: NDArray[np.float64], read: ReadBlock) -> None:
        """See `StoresBlocks`."""
        self._numbers.start(numbers)
        self._places.open_blocks(numbers.shape[1] // PLACES_PER_BLOCK, read)

    def block(self, number: int) -> PlaceBlock:
        """See `StoresBlocks`."""
        return PlaceBlock(self._places.block(number), self._numbers.block(number))

    def add(self, words: NDArray[np.int32]) -> int:
        """See `PlaceRecogniser`."""
        number = self._places.add(words)
        base = self._base(words)
        self._numbers.append((base, base + self._usual + self._usual_weights[words].sum()))
        return number

    def _base(self, words: NDArray[np.int32]) -> float:
        """Log-likelihood of an image without words at a place that shows these."""
        return float(self._gain_unseen[words].sum())

    def _of_samples(self, vocabulary: Vocabulary) -> tuple[float, NDArray[np.float64]]:
        """Mean constant, and (W,) float64 mean weight of each word, over queries by samples."""
        weights = np.zeros(len(vocabulary))
        constant = 0.0
        for sample in vocabulary.samples:
            query = self._query.weigh(sample)
            weights[query.words] += query.weights
            constant += query.constant
        count = max(len(vocabulary.samples), 1)
        return constant / count, weights / count

    def log_likelihoods(self, words: NDArray[np.int32]) -> NDArray[np.float64]:
        """(P,) float64: log p(Z | L) of an image with the words (n,) int32 at each place."""
        query = self._query.weigh(words)
        return self._places.add_weights(query, self._numbers[0] + query.constant)

    def compare(self, words: NDArray[np.int32]) -> Comparison:
        """See `PlaceRecogniser`: the log-likelihood at each place less its mean over the samples.

        In a map of several conditions the likelihoods alone mislead: places seen in dull light
        exceed all others by tens of nats for any image. The mean over images of other places
        corrects for this.
        """
        scores, elsewhere = self._judge(words)
        if len(scores) == 0:
            return Comparison(scores, 1.0)
        evidence = self._evidence(scores, elsewhere)
        return Comparison(
            scores - self._numbers[1],
            float(np.exp(self._prior_elsewhere + elsewhere - evidence)),
        )

    def recognise(self, words: NDArray[np.int32], count: int) -> Recognition:
        """See `PlaceRecogniser`. All places have the same prior."""
        scores, elsewhere = self._judge(words)
        if len(scores) == 0:
            return Recognition(np.zeros(0, np.int64), np.zeros(0), 1.0)
        evidence = self._evidence(scores, elsewhere)
        best = _core.best_scores(scores, count)
        return Recognition(
            best,
            np.exp(scores[best] + self._prior_here - evidence),
            float(np.exp(elsewhere + self._prior_elsewhere - evidence)),
        )

    @property
    def _prior_elsewhere(self) -> float:
        return float(np.log(self.config.new_place_prior))

    @property
    def _prior_here(self) -> float:
        """Log prior of each place."""
        return float(np.log((1 - self.config.new_place_prior) / len(self)))

    def _judge(self, words: NDArray[np.int32]) -> tuple[NDArray[np.float64], float]:
        """(P,) float64 log-likelihood at each place, and that elsewhere."""
        query = self._query.weigh(words)
        sampled = self._elsewhere.add_weights(query, self._elsewhere_base + query.constant)
        here = self._places.add_weights(query, self._numbers[0] + query.constant)
        return here, _log_mean(sampled)

    def _evidence(self, scores: NDArray[np.float64], elsewhere: float) -> float:
        """Log of the sum of prior times likelihood, over all places and elsewhere."""
        greatest = float(scores.max())
        # Terms below e^-40 of the greatest vanish in the rounding of the sum.
        near = scores[scores > greatest - 40.0]
        known = self._prior_here + greatest + float(np.log(np.exp(near - greatest).sum()))
        return float(np.logaddexp(known, self._prior_elsewhere + elsewhere))


def _log_mean(logs: NDArray[np.float64]) -> float:
    """Log of the mean of exp; −∞ for an empty array."""
    if len(logs) == 0:
        return -np.inf
    greatest = float(logs.max())
    return greatest + float(np.log(np.exp(logs - greatest).mean()))


@dataclass(frozen=True, slots=True, eq=False)
class _Weighed:
    """A query, relative to an image without words.

    Attributes:
        constant: log-likelihood of the image at a place without words.
        words: (n,) int32, words seen and their children.
        weights: (n,) float64, change of a place's log-likelihood if it shows the word.
    """

    constant: float
    words: NDArray[np.int32]
    weights: NDArray[np.float64]


class _QueryWeights:
    def __init__(self, model: ObservationModel) -> None:
        unseen, seen = model.log_p
        gain = seen - unseen
        self._has_parent = model.parents >= 0
        self._parents = np.maximum(model.parents, 0)
        self._weight = gain - gain[0]
        self._empty = unseen - unseen[0]
        self._nothing = float(unseen[0].sum())

    def weigh(self, words: NDArray[np.int32]) -> _Weighed:
        z = np.zeros(len(self._parents), np.int8)
        z[words] = 2
        case = z + ((z[self._parents] > 0) & self._has_parent)
        touched = np.flatnonzero(case).astype(np.int32)
        case = case[touched]
        constant = self._nothing + float(self._empty[case, touched].sum())
        return _Weighed(constant, touched, self._weight[case, touched])


class _Postings:
    """Which places show a word: full blocks in a file, then those in memory."""

    def __init__(self, words: int) -> None:
        self._words = words
        self._index = _core.PlaceIndex(words)
        self._blocks = 0
        self._read: ReadBlock = lambda _: None

    @property
    def bytes(self) -> int:
        return self._index.bytes

    def open_blocks(self, count: int, read: ReadBlock) -> None:
        self._blocks, self._read = count, read

    def block(self, number: int) -> builtins.bytes:
        return self._index.block(number - self._blocks)

    def add(self, words: NDArray[np.int32]) -> int:
        return self._blocks * PLACES_PER_BLOCK + self._index.add(words)

    def add_weights(self, query: _Weighed, sums: NDArray[np.float64]) -> NDArray[np.float64]:
        """`sums` (P,), to which the weights of the words that each place shows were added."""
        for number in range(self._blocks):
            of_block = sums[number * PLACES_PER_BLOCK : (number + 1) * PLACES_PER_BLOCK]
            body = self._read(number)
            if body is not None:
                _core.add_block_weights(body, self._words, query.words, query.weights, of_block)
        self._index.add_weights(query.words, query.weights, sums[self._blocks * PLACES_PER_BLOCK :])
        return sums


RECOGNISERS: dict[str, Callable[[Vocabulary], PlaceRecogniser]] = {
    FabMap.name: FabMap,
    Signatures.name: Signatures,
}


def recogniser_names() -> list[str]:
    """All recognisers: Engram's own, then those of other packages."""
    return [*RECOGNISERS, *(name for name in _PLUGINS.names() if name not in RECOGNISERS)]


def recogniser_named(name: str) -> Callable[[Vocabulary], PlaceRecogniser]:
    """What makes the recogniser of that name of a vocabulary.

    Raises:
        IncompatibleError: another package adds it, and it cannot be used.
    """
    return RECOGNISERS[name] if name in RECOGNISERS else _PLUGINS.load(name)


def _checked(name: str, found: Any) -> Callable[[Vocabulary], PlaceRecogniser]:
    if not callable(found) or getattr(found, "name", None) != name:
        raise ConfigError(f"{found!r} must be a class whose name is {name!r}")
    make: Callable[[Vocabulary], PlaceRecogniser] = found
    return make


_PLUGINS = PluginGroup("engram.recognisers", "place recogniser", _checked)
