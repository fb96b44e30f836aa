"""A map's vocabulary: training it from maps and drives, storing and describing it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.config import to_dict
from engram.counts import counted
from engram.errors import IncompatibleError, InputError, MapCorruptError
from engram.frontend.frame import BRIEF, DescriptorKind, Frame, FrameStatus
from engram.frontend.frontend import Frontend
from engram.maps.map import Map
from engram.monitor import QUIET, Monitor
from engram.places.vocabulary import (
    TrainingConfig,
    Vocabulary,
    decode_vocabulary,
    encode_vocabulary,
    hash_of,
    train_vocabulary,
)
from engram.places.words import NodeWords, vocabulary_or_default
from engram.robot.front import arriving
from engram.robot.localisers import DriveSequence
from engram.robot.settings import Settings
from engram.sequences.opening import open_drive
from engram.sequences.sequence import LoggedFrame

MAP_SUFFIX = ".engram"


@dataclass(frozen=True, slots=True)
class VocabularyReport:
    """Properties of a map's vocabulary.

    Attributes:
        images: number of training frames.
        hash: 32 hexadecimal digits that identify it.
        default: whether it is the vocabulary that ships with the package.
        revision: number of the revision that stored it; None if none was stored.
    """

    descriptor: str
    words: int
    images: int
    hash: str
    trained_on: str
    default: bool
    revision: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """What ``vocabulary --json`` prints."""
        found: dict[str, Any] = to_dict(self)
        return found

    def text(self) -> str:
        """For people."""
        whose = "the default vocabulary" if self.default else f"vocabulary {self.hash[:12]}"
        stored = "" if self.revision is None else f", revision {self.revision}"
        return (
            f"{whose}: {self.words} words of {self.descriptor} from "
            f"{counted(self.images, 'frame')} ({self.trained_on}){stored}"
        )


def describe_vocabulary(map_path: Path, at: int | str | None = None) -> VocabularyReport:
    """Describes the vocabulary that relocalises robots in a map.

    Args:
        at: number or tag of its revision; None for the newest.
    """
    with Map.open(map_path, at=at) as opened:
        found = vocabulary_or_default(opened, BRIEF)
        return _report(found, default=opened.vocabulary is None)


def train_map_vocabulary(
    map_path: Path,
    sources: Sequence[Path],
    config: TrainingConfig,
    *,
    author: str,
    monitor: Monitor = QUIET,
) -> VocabularyReport:
    """Trains a vocabulary and stores it in a map, as a revision of its own.

    Args:
        sources: maps and drives to train on; if empty, the map itself.
    """
    with Map.open(map_path) as store:
        kind = store.descriptor
    frames: list[NDArray[np.uint8]] = []
    sources = sources or [map_path]
    with monitor.stage("read", len(sources)) as stage:
        for source in sources:
            for frame in _frames(source, kind):
                kind = kind or frame.descriptor
                if frame.descriptor != kind:
                    raise IncompatibleError(
                        f"{source} has {frame.descriptor} descriptors, the map {kind}; a "
                        "vocabulary has words of one kind"
                    )
                frames.append(frame.landmarks.descriptors)
            stage.advance()
    if kind is None:
        raise InputError(f"{map_path} is empty: map a drive first, or name drives to train on")
    trained_on = ", ".join(source.name for source in sources)
    vocabulary = train_vocabulary(frames, kind, config, trained_on=trained_on, monitor=monitor)
    with Map.open(map_path, writes=True) as writable:
        revision = writable.put_vocabulary(
            encode_vocabulary(vocabulary),
            author=author,
            message=f"vocabulary of {len(vocabulary)} words",
            configuration={"vocabulary": to_dict(config), "trained_on": trained_on},
        )
        NodeWords.of_map(writable, vocabulary).keep_missing(monitor=monitor)
    return _report(vocabulary, default=False, revision=revision.number)


def use_vocabulary(
    map_path: Path,
    source: Path,
    *,
    author: str,
    monitor: Monitor = QUIET,
) -> VocabularyReport:
    """Stores the vocabulary of another map in a map, as a revision of its own.

    Maps of a fleet that share a vocabulary share the words of their nodes.

    Args:
        source: a map with a vocabulary, or an encoded vocabulary.
    """
    vocabulary = _read_vocabulary(source)
    with Map.open(map_path, writes=True) as writable:
        kind = writable.descriptor
        if kind not in {None, vocabulary.descriptor}:
            raise IncompatibleError(
                f"the words of {source} are of {vocabulary.descriptor} descriptors, those of "
                f"{map_path} are {kind}; train a vocabulary for it with engram vocabulary train"
            )
        body = encode_vocabulary(vocabulary)
        if writable.vocabulary == body:
            return _report(vocabulary, default=False)
        revision = writable.put_vocabulary(
            body,
            author=author,
            message=f"vocabulary of {source.name}",
            configuration={"used": source.name},
        )
        NodeWords.of_map(writable, vocabulary).keep_missing(monitor=monitor)
    return _report(vocabulary, default=False, revision=revision.number)


def _read_vocabulary(source: Path) -> Vocabulary:
    if source.suffix != MAP_SUFFIX:
        try:
            return decode_vocabulary(source.read_bytes())
        except OSError as error:
            raise InputError(f"{source} cannot be read: {error.strerror}") from error
        except MapCorruptError as error:
            raise InputError(f"{source}: {error}") from error
    with Map.open(source) as store:
        body = store.vocabulary
    if body is None:
        raise InputError(
            f"{source} has no vocabulary of its own; train one with engram vocabulary train"
        )
    return decode_vocabulary(body)


def _report(
    vocabulary: Vocabulary, *, default: bool, revision: int | None = None
) -> VocabularyReport:
    return VocabularyReport(
        descriptor=str(vocabulary.descriptor),
        words=len(vocabulary),
        images=vocabulary.statistics.images,
        hash=hash_of(vocabulary).hex(),
        trained_on=vocabulary.trained_on,
        default=default,
        revision=revision,
    )


def _frames(source: Path, kind: DescriptorKind | None) -> list[Frame]:
    """The frames of a map's nodes, or the usable frames of a drive."""
    if source.suffix == MAP_SUFFIX:
        with Map.open(source) as store:
            return [store.frames.frame(node) for node in store.read_graph().ids(0) if node]
    sequence: DriveSequence = open_drive(source)
    settings = Settings().for_descriptor(kind)
    frontend = Frontend(settings.frontend)
    with closing(arriving(sequence)) as entries:
        frames = [
            entry.frame if isinstance(entry, LoggedFrame) else frontend.extract(entry)
            for entry in entries
        ]
    return [frame for frame in frames if frame.status is FrameStatus.OK]
