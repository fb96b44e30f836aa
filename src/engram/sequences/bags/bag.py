"""A bag: one file, or the files of a split one, read as one run of messages."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType

from engram.errors import SequenceError
from engram.sequences.bags.compression import ENDINGS, unpack_file
from engram.sequences.bags.database import DatabaseBag
from engram.sequences.bags.mcap import McapBag
from engram.sequences.bags.records import BagFile, DamageError, Record, Topic
from engram.sequences.bags.ros1 import Ros1Bag

CONTAINERS: Mapping[str, Callable[[Path], BagFile]] = MappingProxyType(
    {".bag": Ros1Bag, ".mcap": McapBag, ".db3": DatabaseBag}
)
# What a recorder of ROS 1 that was killed leaves at the name.
_UNFINISHED = ".active"
_NUMBER = re.compile(r"_?(\d+)$")
# A damaged file may fail at every chunk; more than these are only counted.
_MOST_LOSSES = 20


def is_bag(path: Path) -> bool:
    """A bag file, or a folder of the files of one bag; checks names only."""
    if path.is_file():
        return _container(path) is not None
    return len(_split_files(path)) > 0


class Bag:
    """All files of a bag.

    Attributes:
        path: as it was given.
        topics: its topics by name.
        lost: what could not be read so far, without repetitions.

    Raises:
        SequenceError: a file cannot be read at all, or is no bag.
        MissingExtraError: it is compressed, and the extra `bags` is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lost: list[str] = []
        self._unpacked: TemporaryDirectory[str] | None = None
        self._files = [self._opened(file) for file in files_of(path)]
        self.topics: dict[str, Topic] = {}
        for file in self._files:
            try:
                self._merge(file.topics(self.note))
            except DamageError as error:
                if len(self._files) == 1:
                    raise SequenceError(str(error)) from error
                self.note(str(error))
        if not self.topics:
            facts = f": {self.lost[0]}" if self.lost else ""
            raise SequenceError(f"{path}: holds no message that can be read{facts}")

    @property
    def is_ros1(self) -> bool:
        """Whether its messages are serialised as in ROS 1."""
        return self._files[0].is_ros1

    @property
    def size_bytes(self) -> int:
        """Size of its files."""
        return sum(file.path.stat().st_size for file in self._files)

    def records(self, topics: Collection[str] | None = None) -> Iterator[Record]:
        """The messages of some topics (None: of all), file by file, each in its own order."""
        for file in self._files:
            try:
                yield from file.records(topics, self.note)
            except DamageError as error:
                self.note(str(error))

    def note(self, loss: str) -> None:
        """Remembers what could not be read."""
        if loss not in self.lost and len(self.lost) < _MOST_LOSSES:
            self.lost.append(loss)

    def _opened(self, path: Path) -> BagFile:
        if path.suffix in ENDINGS:
            if self._unpacked is None:
                self._unpacked = TemporaryDirectory(prefix="engram-bag-")
            path = unpack_file(path, self._unpacked)
        return CONTAINERS[str(_container(path))](path)

    def _merge(self, topics: Mapping[str, Topic]) -> None:
        for name, topic in topics.items():
            known = self.topics.get(name, Topic(name, topic.type, 0))
            counts = (known.count, topic.count)
            total = None if None in counts else sum(count or 0 for count in counts)
            self.topics[name] = Topic(name, known.type, total)


def files_of(path: Path) -> list[Path]:
    """The files of a bag in order: the file itself, or those of a split bag by number.

    Raises:
        SequenceError: it is not a bag.
    """
    files = [path] if path.is_file() and _container(path) else _split_files(path)
    if not files:
        raise SequenceError(
            f"{path}: is not a bag: needs a file {', '.join(f'NAME{end}' for end in CONTAINERS)}, "
            "or a folder with the files of one bag"
        )
    return files


def _container(path: Path) -> str | None:
    """Ending of the container that a name stands for, compressed or not, or still recorded."""
    ending = Path(path.stem).suffix if path.suffix in (*ENDINGS, _UNFINISHED) else path.suffix
    return ending if ending in CONTAINERS else None


def _split_files(folder: Path) -> list[Path]:
    """The bag files of a folder that are parts of one bag; none if they are several bags."""
    try:
        files = [file for file in folder.iterdir() if _container(file) and file.is_file()]
    except OSError:
        return []
    stems = {_NUMBER.sub("", _bare(file)) for file in files}
    kinds = {_container(file) for file in files}
    if len(kinds) != 1 or (len(stems) != 1 and not (folder / "metadata.yaml").is_file()):
        return []
    return sorted(files, key=_order)


def _bare(file: Path) -> str:
    return file.name.split(".")[0]


def _order(file: Path) -> tuple[int, str]:
    number = _NUMBER.search(_bare(file))
    return (int(number.group(1)) if number else -1, file.name)
