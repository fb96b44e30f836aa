"""What a frame matched, or came closest to matching: two pictures and a sentence."""

from __future__ import annotations

import math
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
from engram.frontend.frame import DescriptorKind, StereoPair
from engram.frontend.frontend import make_thumbnail
from engram.geometry.se3 import SE3
from engram.graph.model import Session
from engram.localiser.acceptance import AcceptanceConfig, Rule, determined
from engram.localiser.attempts import Outcome, outcome_at
from engram.localiser.confidence import confidence_of
from engram.localiser.fixes import LEAST_WEIGHED
from engram.localiser.localisation import Localisation, LocalisationStatus
from engram.maps.map import Map
from engram.robot.robot import LastFrame, Robot
from engram.sequences.layouts import ImageSequence
from engram.sequences.opening import open_drive
from engram.untrusted import printable
from engram.viewing.moments import moment
from engram.viewing.pictures import Image, match_picture, with_caption

# Correlation from which on two small pictures of one stamp are of one image, however exposed.
_SAME_IMAGE = 0.9
# Drives next to one that are searched for the images of a map's nodes.
_NEIGHBOURS = 20
_STATES = {
    LocalisationStatus.DEAD_RECKONING: "carried on by odometry",
    LocalisationStatus.LOST: "lost",
    LocalisationStatus.NO_ODOMETRY: "without odometry",
}
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
        robot: the robot that drives; its graph has its own nodes, too.
        session: the drive.
        images: where whole images may be found.
    """

    def __init__(
        self, opened: Map, robot: Robot, session: Session, images: Images | None = None
    ) -> None:
        self._opened, self._graph = opened, robot.graph
        in_force = robot.in_force
        self._acceptance, self._lanes = in_force.config.acceptance, in_force.budget.lanes
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
            self._details(seen, found, best, mapped.robot),
        )

    def _details(self, seen: LastFrame, found: Localisation, best: Outcome, mapped_by: str) -> str:
        mapped, drives = map(printable, (mapped_by, self._session.robot))
        who = f"mapped by {mapped}, driven by {drives}" if mapped != drives else f"robot {drives}"
        attempt = f"attempt {best.rank + 1} of {len(seen.outcomes)}"
        if min(self._lanes, len(seen.outcomes)) > 1:
            attempt += f", {self._lanes} at a time"
        if found.localised:
            judged = f"confidence {best.confidence:.1f}"
        else:
            why = refusal(best, seen.frame.descriptor, self._acceptance, doubted=seen.refused)
            judged = f"refused: {why}; the robot is {_STATES[found.status]}"
        return f"{who}; {attempt}; {judged}; node {str(best.candidate.node)[:8]}"

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
        return f"no match: {inliers}" if pose is not None else "no match"
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


def refusal(
    outcome: Outcome, kind: DescriptorKind, acceptance: AcceptanceConfig, *, doubted: bool = False
) -> str:
    """Why an attempt that is no fix was refused, with the limit that `MatchRule` applied.

    Args:
        outcome: not accepted.
        kind: of the live frame's features.
        acceptance: in force.
        doubted: whether the run of matches that it continues may be one of look-alikes.
    """
    if outcome.evidence is None:
        return "no pose agrees with its matches"
    elsewhere = "another match of the frame is nearer to where the robot is expected"
    lookalike = "matches of the last metres show less than is usual here, as copies would"
    return (
        _not_weighed(outcome, acceptance)
        or _not_sure(outcome, kind, acceptance)
        or (lookalike if doubted else elsewhere)
    )


def _not_weighed(outcome: Outcome, acceptance: AcceptanceConfig) -> str:
    """Why a match with a pose is not even weighed; "" if it is."""
    inliers, expected = outcome.match.inliers, outcome.candidate.prediction is not None
    fewest = acceptance.min_inliers
    if acceptance.rule is Rule.INLIERS:
        fewest = fewest if expected else acceptance.min_inliers_lost
    elif expected and outcome.candidate.standing.agreed > 0:
        fewest = LEAST_WEIGHED
    if inliers < fewest:
        return f"{counted(inliers, 'inlier')}, limit {fewest}"
    if not determined(outcome.match, acceptance):
        return f"its position is uncertain by more than {acceptance.max_sigma_m:g} m"
    return ""


def _not_sure(outcome: Outcome, kind: DescriptorKind, acceptance: AcceptanceConfig) -> str:
    """Why a match that is weighed is too unsure; "" if it is sure enough."""
    if acceptance.rule is Rule.INLIERS:
        return "off the prediction, too far from the node, or on too little of the image"
    readings = _readings(outcome, kind, acceptance)
    confidence, limit, robot = max(readings, key=lambda one: one[0] - one[1])
    if confidence >= limit:
        return ""
    if confidence == -math.inf:
        return "contradicts where the robot is expected"
    # Rounded down: what is below the limit shall look it.
    return f"confidence {math.floor(100 * confidence) / 100:.2f}, limit {limit:.2f} {robot}"


def _readings(
    outcome: Outcome, kind: DescriptorKind, acceptance: AcceptanceConfig
) -> list[tuple[float, float, str]]:
    """Confidence, limit, and of which robot that is, of each reading of a match with a pose."""
    model, candidate, evidence = confidence_of(kind), outcome.candidate, outcome.evidence
    assert evidence is not None
    readings = []
    if candidate.prediction is not None and candidate.standing.agreed > 0:
        near, limit = model.as_predicted(evidence), acceptance.min_confidence
        readings.append((near, limit, "where a match is expected"))
    elif candidate.prediction is not None:
        near, limit = model.as_predicted(evidence), acceptance.min_confidence_told
        readings.append((near, limit, "near an unconfirmed position"))
    if candidate.prediction is None or candidate.doubted:
        limit = acceptance.min_confidence_lost
        if candidate.lost_long:
            limit = max(limit, acceptance.sure_confidence)
        readings.append((model.as_anywhere(evidence), limit, "for a lost robot"))
    return readings


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
