"""Messages of known types, by `rosbags`; definitions that a bag carries are never compiled."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import Any

from engram.sequences.bags.bag import Bag
from engram.sequences.bags.compression import needs_bags
from engram.sequences.bags.records import DamageError, Record
from engram.sequences.clocks import SteadyClock, Timed, in_time

_TF = "tf2_msgs/msg/TFMessage"
# Messages of which one has a stamp, if a topic has any.
_STATED_WITHIN = 100


class Decoder:
    """Decodes the messages of a bag.

    Args:
        is_ros1: whether they are serialised as in ROS 1, else as CDR.

    Raises:
        MissingExtraError: the extra `bags` is not installed.
    """

    def __init__(self, is_ros1: bool) -> None:
        self._store = _store(is_ros1)
        self._decode = self._store.deserialize_ros1 if is_ros1 else self._store.deserialize_cdr

    def knows(self, kind: str) -> bool:
        """Whether messages of this type can be decoded."""
        return kind in self._store.fielddefs

    def message(self, record: Record, kind: str) -> Any:
        """The decoded message; its fields as in ROS 2, arrays as NumPy.

        Raises:
            DamageError: its bytes are not a message of this type.
        """
        try:
            return self._decode(record.data, kind)
        except Exception as error:  # bytes of another type fail in many ways
            raise DamageError(f"is not a {kind}: {type(error).__name__} {error}"[:200]) from error


@functools.cache
def _store(is_ros1: bool) -> Any:
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise needs_bags(error) from error
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    if _TF not in store.fielddefs:  # not among the types of ROS 1 that rosbags brings
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TF))
    return store


class Stamps:
    """The capture times of a topic: of the headers, or of the recording if a driver states none.

    A single zero is a fault; only a topic whose first hundred stamps are all zero has none. The
    recorder's clock may be another: in simulation it is.

    Args:
        bag: the bag.
        decoder: decodes its messages.
        topic: the topic.
    """

    def __init__(self, bag: Bag, decoder: Decoder, topic: str) -> None:
        self._stated = False
        kind = bag.topics[topic].type
        for record in islice(bag.records({topic}), _STATED_WITHIN):
            with suppress(DamageError):
                self._stated = self._stated or _header_ns(decoder.message(record, kind)) != 0
            if self._stated:
                break

    def of(self, message: Any, record: Record) -> int:
        """Capture time of a message, ns."""
        return _header_ns(message) if self._stated else record.received_ns


def messages(bag: Bag, decoder: Decoder, topic: str) -> Iterator[tuple[Any, Record]]:
    """The messages of a topic that can be read; the others are noted."""
    kind = bag.topics[topic].type
    for record in bag.records({topic}):
        try:
            yield decoder.message(record, kind), record
        except DamageError as error:
            bag.note(f"{topic}: {error}")


def timed_messages(
    bag: Bag, decoder: Decoder, topic: str, clock: SteadyClock
) -> Iterator[Timed[tuple[Any, Record]]]:
    """The messages of a topic by rising time; see `engram.sequences.clocks`."""
    stamps = Stamps(bag, decoder, topic)
    return in_time(
        messages(bag, decoder, topic),
        lambda one: stamps.of(*one),
        clock,
        lambda one: one[1].received_ns,
    )


def clock_of(bag: Bag, decoder: Decoder, topic: str) -> SteadyClock:
    """The clock of a topic, after all its stamps."""
    clock = SteadyClock(waits=True)
    for _ in timed_messages(bag, decoder, topic, clock):
        pass
    return clock


def _header_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def same_type(kind: str) -> str:
    """The type's present name: ROS 1 has both tf/tfMessage and tf2_msgs/TFMessage."""
    return _TF if kind == "tf/msg/tfMessage" else kind
