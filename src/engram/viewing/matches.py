"""What a frame matched, or came closest to matching: two pictures and a sentence."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from engram.counts import counted
from engram.errors import EngramError, InputError
from engram.frontend.frame import StereoPair
from engram.frontend.frontend import make_thumbnail
from engram.geometry.se3 import SE3
from engram.graph.graph import ExperienceGraph
from engram.graph.model import Session
from engram.localiser.attempts import Outcome, outcome_at
from engram.localiser.localisation import Localisation
from engram.maps.map import Map
from engram.robot.robot import LastFrame
from engram.sequences.layouts import ImageSequence
from engram.sequences.opening import open_drive
from engram.untrusted import printable
from engram.viewing.moments import moment
from engram.viewing.pictures import Image, match_picture, with_caption

# Correlation from which on two small pictures of one stamp are of one image, however exposed.
_SAME_IMAGE = 0.9
# Drives next to one that are searched for the images of a map's nodes.
_NEIGHBOURS = 20
# A turn, and an offset to the side, that a caption mentions.
_TURN_RAD, _ASIDE_M = float(np.deg2rad(5.0)), 0.5


class Images(Protocol):
    """Where whole images may be found of which a map or a frame log has small pictures."""

    def find(self, stamp_ns: int, small: Image) -> Image | None:
        """The whole left image, (h, w) uint8, of a stamp and a small picture; None if unknown."""
        ...


class NoImages:
    """No images but those stored."""

    def find(self, stamp_ns: int, small: Image) -> Image | None:
        """See `Images`."""
        del stamp_ns, small
        return None


class NeighbouringDrives:
    """The drives in the folder of a drive, as images: a map's own drives often lie there."""

    def __init__(self, path: Path) -> None:
        self._folder = path.resolve().parent
        self._drives: list[ImageSequence] | None = None

    def find(self, stamp_ns: int, small: Image) -> Image | None:
        """See `Images`; only an image that looks like the small picture."""
        if self._drives is None:
            self._drives = list(_image_drives(self._folder))
        for drive in self._drives:
            for index in np.flatnonzero(drive.stamps_ns == stamp_ns).tolist():
                with suppress(EngramError):
                    image = drive.read(index).left
                    if shows(image, small):
                        return image
        return None


def _image_drives(folder: Path) -> Iterable[ImageSequence]:
    with suppress(OSError):
        for path in sorted(folder.iterdir())[:_NEIGHBOURS]:
            if path.is_dir():
                with suppress(EngramError):
                    drive = open_drive(path)
                    if isinstance(drive, ImageSequence):
                        yield drive


def shows(image: Image, small: Image) -> bool:
    """Whether a small picture is of an image, both (h, w) uint8, however exposed."""
    reduced = make_thumbnail(image)
    if reduced.shape != small.shape:
        return False
    one, other = (side.astype(np.float64) - side.mean() for side in (reduced, small))
    scale = np.sqrt((one**2).sum() * (other**2).sum())
    return bool(scale > 0 and (one * other).sum() >= _SAME_IMAGE * scale)


@dataclass(frozen=True, slots=True, eq=False)
class ShownMatch:
    """A frame of a drive with the node that it matched, or came closest to.

    Attributes:
        frame: its number.
        stamps_ns: of the node and of the frame.
        at_m: distance driven by then, metres.
        draw: makes the picture while the map is open, (h, w, 3) uint8 BGR: both images with what
            they share.
        caption, details: two sentences about it.
    """

    frame: int
    stamps_ns: tuple[int, int]
    at_m: float
    draw: Callable[[], Image]
    caption: str
    details: str


class MatchShower:
    """Shows the frames of a drive with the nodes that they matched.

    Args:
        opened: the map.
        graph: that of the robot, with its own nodes.
        session: the drive.
        images: where whole images may be found.
    """

    def __init__(
        self, opened: Map, graph: ExperienceGraph, session: Session, images: Images | None = None
    ) -> None:
        self._opened, self._graph = opened, graph
        self._session, self._images = session, images or NoImages()

    def show(
        self, seen: LastFrame, found: Localisation, frame: int, at_m: float
    ) -> ShownMatch | None:
        """The frame just localised; None if nothing was attempted, or no image is known."""
        tried = [one for one in seen.outcomes if not one.damaged]
        success = outcome_at(seen.outcomes, found.node)
        best = success or max(tried, key=lambda one: (one.match.inliers, -one.rank), default=None)
        pictured = isinstance(seen.arrived, StereoPair) or seen.frame.thumbnail is not None
        if best is None or not pictured:
            return None
        node = self._graph.node(self._graph.index(best.candidate.node))
        mapped = self._opened.sessions.get(node.session, self._session)
        then, now = moment(mapped, node.stamp_ns), moment(self._session, found.stamp_ns)
        return ShownMatch(
            frame,
            (node.stamp_ns, found.stamp_ns),
            at_m,
            partial(self._picture, seen, best, node.stamp_ns, (f"map: {then}", f"drive: {now}")),
            f"{then} → {now}, {_sentence(best, matched=success is not None)}",
            _details(seen, found, best, (mapped.robot, self._session.robot)),
        )

    def _live(self, seen: LastFrame) -> Image:
        if isinstance(seen.arrived, StereoPair):
            return seen.arrived.left
        small = seen.frame.thumbnail
        assert small is not None
        whole = self._images.find(seen.frame.stamp_ns, small)
        return small if whole is None else whole

    def _of_node(self, best: Outcome, stamp_ns: int, shape: tuple[int, ...]) -> Image:
        with suppress(EngramError):  # damaged, or of this drive: engram check tells
            small = self._opened.frames.thumbnail(best.candidate.node)
            if small is not None:
                whole = self._images.find(stamp_ns, small)
                return small if whole is None else whole
        return np.zeros(shape, np.uint8)

    def _picture(
        self, seen: LastFrame, best: Outcome, stamp_ns: int, names: tuple[str, str]
    ) -> Image:
        live = self._live(seen)
        image = self._of_node(best, stamp_ns, live.shape)
        node = self._opened.frames.frame(best.candidate.node)
        size = np.array([node.camera.width, node.camera.height], dtype=np.float32)
        scale = np.float32(live.shape[1] / seen.frame.camera.width)
        return match_picture(
            image,
            live,
            node.landmarks.pixels[best.match.reference_rows] / size,
            seen.frame.landmarks.pixels[best.match.live_rows] * scale,
            names,
        )


def _sentence(best: Outcome, *, matched: bool) -> str:
    inliers = counted(best.match.inliers, "inlier")
    pose = best.match.reference_from_live
    if not matched:
        return f"no match: {inliers}" if pose is not None else "no match: nothing agrees"
    assert pose is not None
    return f"{_relative(pose)}, {inliers}"


def _relative(node_from_live: SE3) -> str:
    """Where the robot was, seen from the node's camera."""
    right_m, _, ahead_m = node_from_live.translation.tolist()
    words = [f"{abs(ahead_m):.1f} m {'ahead' if ahead_m >= 0 else 'behind'}"]
    if abs(right_m) >= _ASIDE_M:
        words.append(f"{abs(right_m):.1f} m to the {'right' if right_m > 0 else 'left'}")
    if abs(node_from_live.yaw_rad) >= _TURN_RAD:
        side = "right" if node_from_live.yaw_rad > 0 else "left"
        words.append(f"turned {abs(np.rad2deg(node_from_live.yaw_rad)):.0f}° {side}")
    return ", ".join(words)


def _details(seen: LastFrame, found: Localisation, best: Outcome, robots: tuple[str, str]) -> str:
    mapped, drives = map(printable, robots)
    who = f"mapped by {mapped}, driven by {drives}" if mapped != drives else f"robot {drives}"
    attempt = f"attempt {best.rank + 1} of {len(seen.outcomes)}"
    sure = f", confidence {best.confidence:.1f}" if np.isfinite(best.confidence) else ""
    lost = "" if found.localised else f"; {found.status.value.replace('_', ' ')}"
    return f"{who}; {attempt}{sure}{lost}; node {str(best.candidate.node)[:8]}"


class PictureWriter:
    """Writes a picture of the match, or of the best attempt, at regular intervals.

    Args:
        every: frames from one picture to the next.
    """

    def __init__(self, folder: Path, every: int, shower: MatchShower) -> None:
        self._folder, self._every, self._shower = folder, every, shower
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder}: cannot be created: {error.strerror}") from error

    def see(self, seen: LastFrame, found: Localisation, frame: int, at_m: float) -> None:
        """Writes a picture of the frame just localised, if it is due."""
        if frame % self._every:
            return
        shown = self._shower.show(seen, found, frame, at_m)
        if shown is None:
            return
        path = self._folder / f"{frame:06d}_{found.status.value}.png"
        picture = with_caption(shown.draw(), f"{shown.caption}; {shown.details}")
        if not cv2.imwrite(str(path), picture):
            raise InputError(f"{path}: the picture cannot be written; is the disk full?")
