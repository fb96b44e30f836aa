"""What a bag file holds, whatever its container: topics, and records in the order of the file.

Containers are read from front to back, bounded in memory, so that a file that was cut short or
damaged gives what it still holds. Each reader's output equals that of `rosbags` on sound files;
`rosbags` itself refuses unsound ones, and unpacks chunks of any size.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

# A chunk or message of this size holds 64 megapixels in colour: no camera sends more.
MAX_BYTES = 256_000_000

Report = Callable[[str], None]


class DamageError(Exception):
    """A part of a bag cannot be read; says which and why."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: its name, such as /stereo/left/image_raw.
        type: type of its messages, such as sensor_msgs/msg/Image.
        count: number of its messages; None if the bag has no index.
    """

    name: str
    type: str
    count: int | None = None


@dataclass(frozen=True, slots=True)
class Record:
    """One message of a bag, not decoded.

    Attributes:
        topic: its topic.
        received_ns: when it was recorded, ns.
        data: the serialised message.
    """

    topic: str
    received_ns: int
    data: bytes


class BagFile(Protocol):
    """One file of a bag.

    Attributes:
        path: the file.
        is_ros1: whether its messages are serialised as in ROS 1, else as CDR.
    """

    path: Path
    is_ros1: bool

    def topics(self, lost: Report) -> dict[str, Topic]:
        """The topics by name.

        Args:
            lost: receives what cannot be read.

        Raises:
            DamageError: the file is of another kind, or nothing can be read.
        """
        ...

    def records(self, topics: Collection[str] | None, lost: Report) -> Iterator[Record]:
        """The records of some topics (None: of all) in the order of the file.

        Args:
            topics: names of topics; records of others are passed over undecoded.
            lost: receives what cannot be read.
        """
        ...


def message_type(name: str) -> str:
    """A type's name as in ROS 2: sensor_msgs/Image → sensor_msgs/msg/Image."""
    package, _, kind = name.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{kind}" if package else name


def topic_of(name: str, kind: str, encoding: str, read: str) -> Topic:
    """A topic; the type of one whose messages are not encoded as those that are read says so."""
    return Topic(name, kind if encoding == read else f"{kind} in {encoding or 'no encoding'}")


def counted(topics: dict[str, Topic], counts: dict[str, int]) -> dict[str, Topic]:
    """The topics with the number of their messages."""
    return {name: Topic(name, topic.type, counts.get(name, 0)) for name, topic in topics.items()}
