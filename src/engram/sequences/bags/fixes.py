"""The fixes of a bag's satellite receiver: `sensor_msgs/NavSatFix`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from engram.errors import InputError
from engram.sequences.bags.containers import Bag
from engram.sequences.bags.messages import Decoder, timed_messages
from engram.sequences.clocks import SteadyClock

FIX = "sensor_msgs/msg/NavSatFix"


@dataclass(frozen=True, slots=True)
class Fix:
    """A position by satellites.

    Attributes:
        time_ns: UTC, ns.
        latitude_deg, longitude_deg: WGS 84, degrees.
        altitude_m: above the ellipsoid, metres; None if unknown.
        sigma_m: standard deviation of the horizontal position, metres; None if unknown.
    """

    time_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    sigma_m: float | None


def read_fixes(path: Path, topic: str | None = None) -> list[Fix]:
    """The fixes of a bag, by rising time; messages without a fix are left out.

    Args:
        topic: topic of the fixes; None if the bag has only one.
    """
    bag = Bag(path)
    known = fix_topics(bag)
    listed = f"topics with fixes: {', '.join(known) or 'none'}"
    if topic is not None and topic not in known:
        raise InputError(f"--topic {topic}: holds no {FIX}; {listed}")
    if topic is None and len(known) != 1:
        raise InputError(f"{path}: name the topic with --topic; {listed}")
    named = topic or known[0]
    fixes = {fix.time_ns: fix for fix in fixes_of(bag, named, Decoder(bag.is_ros1))}
    if not fixes:
        facts = f"; {bag.lost[0]}" if bag.lost else ""
        raise InputError(f"{path}: {named} holds no fix: all its messages report none{facts}")
    return [fixes[time_ns] for time_ns in sorted(fixes)]


def fix_topics(bag: Bag) -> list[str]:
    """Names of the topics with fixes, empty ones left out."""
    return sorted(
        topic.name for topic in bag.topics.values() if topic.type == FIX and topic.count != 0
    )


def fixes_of(
    bag: Bag, topic: str, decoder: Decoder, clock: SteadyClock | None = None
) -> Iterator[Fix]:
    """The fixes of a topic by rising time; messages without a fix are left out."""
    for message in timed_messages(bag, decoder, topic, clock or SteadyClock(waits=True)):
        fix = _fix(message.item[0], message.time_ns)
        if fix is not None:
            yield fix


def _fix(message: Any, time_ns: int) -> Fix | None:
    """A message as a fix; None where the receiver had none."""
    at = float(message.latitude), float(message.longitude)
    if message.status.status < 0 or not np.isfinite(at).all():
        return None
    if abs(at[0]) > 90 or abs(at[1]) > 180:
        return None
    variance = max(float(message.position_covariance[0]), float(message.position_covariance[4]))
    known = message.position_covariance_type > 0 and np.isfinite(variance) and variance > 0
    height = float(message.altitude)
    return Fix(
        time_ns,
        *at,
        height if np.isfinite(height) else None,
        float(np.sqrt(variance)) if known else None,
    )
