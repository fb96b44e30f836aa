"""Messages of known types, by `rosbags`; definitions that a bag carries are never compiled."""

from __future__ import annotations

import functools
from typing import Any

from engram.sequences.bags.compression import needs_bags
from engram.sequences.bags.records import DamageError, Record

_TF = "tf2_msgs/msg/TFMessage"


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


def stamp_of(message: Any, record: Record) -> int:
    """Capture time, ns: of the header, or of the recording if the driver left it at zero."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec) or record.received_ns


def same_type(kind: str) -> str:
    """The type's present name: ROS 1 has tf/tfMessage beside tf2_msgs/TFMessage."""
    return _TF if kind == "tf/msg/tfMessage" else kind
