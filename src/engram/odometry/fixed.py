"""What is fixed to the camera, not to the world: a bonnet, a gripper, dirt, a burnt-in text.

It moves with the robot, so that it seems to stand still, in odometry and in every match: its
corners keep their pixels, however far the robot drives. So does the whole world while a robot
stands, and what is far away on a straight road. Two things tell them apart. Landmarks that keep
their pixels *defy* the motion that all the others agree on only if that motion would have moved
them, at their depth. And who is right, the ones that rest or the others, is decided by wheels and
gyroscope; without them by depth, since what is fixed to a robot lies in front of the world; and
otherwise it is left open: then neither is used.

Cells of the image whose landmarks defied the motion again and again are learnt as fixed, and
forgotten when their landmarks move like the others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import partial
from typing import Annotated

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from engram import _core
from engram.config import check_bounds
from engram.frontend.frame import Frame, FrameStatus, Landmarks
from engram.frontend.matching import MatcherConfig, features, match_frames
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.odometry.step import Guess

_NOTHING = np.zeros(0, np.bool_)
# Most frames over which landmarks are compared.
_LONGEST_SPAN = 8
# Motions from which wheels, and a gyroscope, tell rest from motion, and the share that is rest.
_LEAST_M, _LEAST_RAD, _REST_SHARE = 0.02, float(np.deg2rad(1.0)), 0.5
# Disparities may be wrong by so much beside their own σ, px.
_OFFSET_PX = 0.3


@dataclass(frozen=True, slots=True)
class FixedConfig:
    """Settings of `FixedPixels`. Source: `lab/reports/fixed.md`."""

    cells: Annotated[
        int,
        Meta(ge=8, le=1000, description="cells that are learnt, along the width of the image"),
    ] = 40
    same_bits: Annotated[
        int, Meta(ge=0, description="most different bits of a landmark that kept its pixel")
    ] = 45
    same_disparity_px: Annotated[
        float, Meta(gt=0, description="largest change of disparity of such a landmark, px")
    ] = 1.0
    flow_px: Annotated[
        float,
        Meta(
            gt=1,
            description="least distance, px, by which the others' motion would have moved a "
            "landmark that kept its pixel, for it to contradict that motion",
        ),
    ] = 4.0
    defying: Annotated[
        float,
        Meta(gt=0, lt=1, description="least share of landmarks that contradict a motion together"),
    ] = 0.03
    others: Annotated[
        int, Meta(ge=6, description="fewest landmarks that agree on the others' motion")
    ] = 25
    others_share: Annotated[
        float,
        Meta(gt=0, le=1, description="their least share among all landmarks that moved"),
    ] = 0.12
    majority: Annotated[
        float,
        Meta(
            gt=1,
            description="ratio of moving to contradicting landmarks, or the reverse, from which "
            "the larger group is the world",
        ),
    ] = 2.0
    one_depth: Annotated[
        float,
        Meta(gt=1, description="largest ratio of depths that count as one depth"),
    ] = 1.3
    near_keeps: Annotated[
        float,
        Meta(
            gt=0,
            le=1,
            description="least share of near landmarks with kept pixels, to ride with the camera",
        ),
    ] = 0.5
    behind_keeps: Annotated[
        float,
        Meta(
            ge=0,
            lt=1,
            description="largest share of the landmarks behind them with kept pixels, for the same",
        ),
    ] = 0.1
    behind: Annotated[
        float, Meta(gt=0, lt=1, description="least share of landmarks behind them, for the same")
    ] = 0.25
    votes: Annotated[
        float, Meta(gt=0, description="votes after which a cell is fixed to the camera")
    ] = 2.5
    most_votes: Annotated[
        float, Meta(gt=0, description="most votes of a cell, so that removed objects fade")
    ] = 6.0
    weak_votes: Annotated[
        float, Meta(gt=0, description="votes after which a cell next to a fixed one is fixed, too")
    ] = 0.9
    forgets: Annotated[
        float, Meta(gt=0, lt=1, description="share of its votes that a cell loses at each look")
    ] = 0.03
    least_share: Annotated[
        float,
        Meta(gt=0, lt=1, description="least share of the image that is learnt; less does no harm"),
    ] = 0.01
    every: Annotated[
        int, Meta(ge=1, description="frames from one look to the next while nothing is fixed")
    ] = 4
    first: Annotated[
        int, Meta(ge=0, description="first frames of a drive, all of which are examined")
    ] = 12

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True, slots=True, eq=False)
class FixedLook:
    """What a look at one frame found.

    Attributes:
        frame: the frame without the landmarks that are fixed to the camera, or may be.
        doubted: whether it is open which landmarks are the world: those that rest, or those
            that move.
    """

    frame: Frame
    doubted: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class _Parted:
    """Landmarks of a reference frame, by what they did until another frame.

    Attributes:
        defies: (N,) bool, those that kept their pixel though this motion would have moved them.
        agreeing: rows of those that agree on the motion.
        moving: rows of those among them that it moved far.
    """

    motion: SE3
    defies: NDArray[np.bool_]
    agreeing: NDArray[np.intp]
    moving: NDArray[np.intp]

    @property
    def share(self) -> float:
        """Share of the landmarks that defy the motion."""
        return float(self.defies.mean())


class _World(Enum):
    """Which part of an image shows the world."""

    RESTS = auto()
    MOVES = auto()
    UNKNOWN = auto()


class FixedPixels:
    """Learns which pixels of a camera show something that moves with it.

    Args:
        config: when a landmark defies the others, and when that counts.
        matcher: how frames are matched.

    Attributes:
        doubts: looks that left open which of the two is right.
    """

    def __init__(
        self, config: FixedConfig | None = None, matcher: MatcherConfig | None = None
    ) -> None:
        self._config = config or FixedConfig()
        self._matcher = matcher or MatcherConfig()
        self._reference: Frame | None = None
        # Motion since the reference, from outside and by odometry; None if it was not measured
        # throughout. The last step of odometry.
        self._outside: SE3 | None = None
        self._seen: SE3 | None = None
        self._step: SE3 | None = None
        # Of the last look: motion by odometry from the reference to the frame before, and by the
        # landmarks that kept no pixel to this one.
        self._others: tuple[SE3 | None, SE3] | None = None
        # How many landmarks kept their pixels before a world that moved, however far.
        self._near = 0
        # Whether odometry rested where the others moved.
        self._led_astray = False
        self._age = self._looked = 0
        self._span = 1
        self._suspicious = False
        # Votes of each cell: for being fixed to the camera, and for moving with the world.
        self._fixed = self._moving = np.zeros((0, 0), np.float32)
        self._cells = np.zeros((0, 0), np.bool_)
        # Disparity of what was fixed in each cell, px, and of the fixed cells around each cell.
        self._disparity_px = self._around_px = np.zeros((0, 0), np.float32)
        self.doubts = 0

    @property
    def share(self) -> float:
        """Share of the image that is fixed to the camera."""
        return float(self._cells.mean()) if self._cells.size else 0.0

    def mask(self, camera: StereoCamera) -> NDArray[np.bool_]:
        """(height, width) bool of the rectified left image, False where it is fixed to the camera.

        Args:
            camera: of the frames.
        """
        if not self._cells.size:
            return np.ones((camera.height, camera.width), np.bool_)
        side = self._side_px(camera)
        whole = np.kron(~self._cells, np.ones((side, side), np.bool_))
        return np.asarray(whole[: camera.height, : camera.width], np.bool_)

    def restart(self) -> None:
        """Another stretch of the drive begins; what was learnt stays."""
        self._reference, self._age = None, 0
        self._outside = self._seen = self._step = None

    def note(self, step: SE3 | None, inliers: int) -> bool:
        """Takes the motion to the frame of the last look by odometry.

        Args:
            step: prev_from_curr; None if it failed.

        Returns:
            Whether odometry all but rests where the others of that look have moved: it may follow
            a lorry ahead, or something on the lens.
        """
        (others, self._others), (near, self._near) = (self._others, None), (self._near, 0)
        # Where far more agree on a rest than lie near, the world rests with them.
        moves = near > 0 and inliers <= self._config.majority * near
        told = moves or others is not None
        if step is not None and told:
            self._led_astray = moves and step.distance_m < _LEAST_M and step.angle_rad < _LEAST_RAD
            if others is not None and others[0] is not None:
                seen_m = (others[0] @ step).distance_m
                self._led_astray |= bool(_is_small(seen_m, others[1].distance_m, _LEAST_M))
        self._step = step
        if self._age == 0:
            self._seen = SE3.identity()
        else:
            self._seen = None if self._seen is None or step is None else self._seen @ step
        astray = self._led_astray and told
        self.doubts += astray
        return astray

    def look(self, frame: Frame, outside: Guess | None, told: SE3 | None) -> FixedLook:
        """Looks at the next frame of the camera.

        Args:
            outside: what wheels and gyroscope may be trusted with at this frame; None if nothing.
            told: the motion since the last frame by them, prev_from_curr; None if not measured.
        """
        self._outside = None if self._outside is None or told is None else self._outside @ told
        if frame.status is not FrameStatus.OK or not len(frame.landmarks):
            return FixedLook(frame)
        self._age, self._looked = self._age + 1, self._looked + 1
        reference = self._reference
        if reference is None or not _comparable(reference, frame):
            self._refer(frame)
        elif self._is_due():
            return self._looked_at(reference, frame, outside)
        return FixedLook(self._without(frame))

    def _is_due(self) -> bool:
        """Whether the frame is compared with the reference, which lies some frames back."""
        suspects = self._suspicious or self._led_astray or self._looked <= self._config.first
        always = suspects or bool(self._cells.any())
        return self._age >= (self._span if always else self._config.every)

    def _refer(self, frame: Frame, *, other_span: bool = False) -> None:
        """Later frames are compared with this one, perhaps over another number of frames."""
        self._reference, self._age, self._outside = frame, 0, SE3.identity()
        if other_span:
            self._span = 1 if self._span >= _LONGEST_SPAN else 2 * self._span

    def _looked_at(self, reference: Frame, frame: Frame, outside: Guess | None) -> FixedLook:
        """Which landmarks kept their pixel, how the others moved, and which are the world."""
        kept, told = kept_rows(reference, frame, self._config), self._outside
        keeps = kept >= 0
        parted = None
        if self._may_defy(reference, keeps):
            parted = self._parted(reference, frame, kept)
        self._suspicious = parted is not None and parted.share >= self._config.defying
        # What is slow or far moves enough over more frames, what is fast is matched over fewer.
        finds = self._suspicious or (parted is not None and bool(self._cells.any()))
        self._refer(frame, other_span=not finds)
        if parted is None:
            if _stands(told, outside):  # what lies behind has vanished, not moved
                return FixedLook(self._without(frame))
            near = self._near_rests(reference, keeps)
            return FixedLook(self._without(frame, self._thing(reference, frame, kept, near)))
        world = self._world(reference, parted, _rests(told, outside, parted.motion))
        if world is not _World.RESTS:
            self._others = self._seen, parted.motion
        if world is _World.RESTS:
            return FixedLook(self._without(frame))
        if not self._suspicious:
            self._vote(reference, np.zeros(len(kept), np.bool_), parted.moving)
            return FixedLook(self._without(frame))
        defies = self._with_its_middle(reference, parted.defies, keeps)
        if world is _World.MOVES:
            self._vote(reference, defies, parted.moving)
        else:
            self.doubts += 1
        gone = _there(kept[defies], len(frame.landmarks))
        return FixedLook(self._without(frame, gone), doubted=world is _World.UNKNOWN)

    def _thing(
        self, reference: Frame, frame: Frame, kept: NDArray[np.int32], near: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Votes for what is nearer than the world and rests; its landmarks in the frame."""
        if near.any():
            self._suspicious, self._near = True, int(np.count_nonzero(near))
            self._vote(reference, near, np.zeros(0, np.intp))
        return _there(kept[near], len(frame.landmarks))

    def _near_rests(self, reference: Frame, keeps: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which landmarks keep their pixels though those behind them do not; none in a world.

        A camera that moves moves what is near further than what lies behind it, and one that turns
        moves both alike. So this decides whatever the camera's motion.
        """
        config, depth_m = self._config, reference.landmarks.points_in_cam[:, 2]
        nothing = np.zeros(len(keeps), np.bool_)
        if keeps.all() or keeps.mean() < config.defying:
            return nothing
        before = keeps & (depth_m < np.median(depth_m[~keeps]))
        if before.mean() < config.defying:
            return nothing
        near = depth_m <= config.one_depth * np.median(depth_m[before])
        behind = ~near
        if behind.mean() < config.behind:
            return nothing
        rests = keeps[near].mean() >= config.near_keeps
        moves = keeps[behind].mean() <= config.behind_keeps
        return keeps & near if rests and moves else nothing

    def _may_defy(self, reference: Frame, keeps: NDArray[np.bool_]) -> bool:
        """Whether it pays to ask how the others moved: the cheap half of a look."""
        config = self._config
        if self._cells.any():
            return True
        if keeps.mean() < config.defying:
            return False
        if self._seen is None or self._step is None:
            return True
        expected = least_flow_px(reference.landmarks, reference.camera, self._seen @ self._step)
        far = expected >= config.flow_px
        if np.count_nonzero(far) < 0.5 * len(keeps):
            return True  # odometry says that the camera rests: it may have been led astray
        return float((keeps & far).mean()) >= 0.5 * config.defying

    def _parted(self, reference: Frame, frame: Frame, kept: NDArray[np.int32]) -> _Parted | None:
        """Parts landmarks that keep their pixels from those that move; None if too few do."""
        config, keeps = self._config, kept >= 0
        others = match_frames(
            _some(reference, ~keeps),
            _some(frame, ~_there(kept[keeps], len(frame.landmarks))),
            self._matcher,
            frame.stamp_ns % 2**63,
        )
        motion = others.reference_from_live
        enough = max(config.others, config.others_share * np.count_nonzero(~keeps))
        if motion is None or others.inliers < enough:
            return None
        moved_px = least_flow_px(reference.landmarks, reference.camera, motion)
        agreeing = np.flatnonzero(~keeps)[others.reference_rows]
        moving = agreeing[moved_px[agreeing] >= config.flow_px]
        if 2 * len(moving) < len(agreeing):
            return None
        return _Parted(motion, keeps & (moved_px >= config.flow_px), agreeing, moving)

    def _world(self, reference: Frame, parted: _Parted, rests: bool | None) -> _World:
        """Whether the world is what rests in the image, or what moves.

        Wheels and gyroscope decide. Without them, what rests is no world if it lies before what
        moves, or all at one depth. Else those outnumbered by far pass by, or ride along.
        """
        if rests is not None:
            return _World.RESTS if rests else _World.MOVES
        resting, moving = np.count_nonzero(parted.defies), len(parted.agreeing)
        majority = self._config.majority
        if moving >= majority * resting or self._in_front(reference, parted):
            return _World.MOVES
        return _World.RESTS if resting >= majority * moving else _World.UNKNOWN

    def _in_front(self, reference: Frame, parted: _Parted) -> bool:
        """Whether what rests is a thing before what moves, or all at one depth."""
        if not parted.defies.any() or self._is_flat(reference, parted.defies):
            return True
        depth_m = reference.landmarks.points_in_cam[:, 2]
        resting, moving = depth_m[parted.defies], depth_m[parted.agreeing]
        return bool(np.percentile(resting, 90) < np.percentile(moving, 25))

    def _is_flat(self, reference: Frame, defies: NDArray[np.bool_]) -> bool:
        """Whether all that rests lies at one depth."""
        if not defies.any():
            return False
        nearest, farthest = np.percentile(reference.landmarks.points_in_cam[defies, 2], (10, 90))
        return bool(farthest < self._config.one_depth * nearest)

    def _with_its_middle(
        self, reference: Frame, defies: NDArray[np.bool_], keeps: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Those that defy the motion, and of a flat thing those that it would not have moved."""
        if not self._is_flat(reference, defies):
            return defies
        disparity_px = reference.landmarks.disparity_px
        off_px = np.abs(disparity_px - np.median(disparity_px[defies]))
        return np.asarray(defies | (keeps & (off_px <= self._config.same_disparity_px)), np.bool_)

    def _vote(self, reference: Frame, defies: NDArray[np.bool_], moving: NDArray[np.intp]) -> None:
        if not self._fixed.size:
            camera = reference.camera
            side = self._side_px(camera)
            shape = -(-camera.height // side), -(-camera.width // side)
            self._fixed, self._moving, self._disparity_px = np.zeros((3, *shape), np.float32)
        keep = 1.0 - self._config.forgets
        pixels = reference.landmarks.pixels
        side = self._side_px(reference.camera)
        self._fixed = keep * self._fixed + self._seen_in(pixels[defies], side)
        self._fixed = np.minimum(self._fixed, self._config.most_votes)
        self._moving = keep * self._moving + self._seen_in(pixels[moving], side)
        columns, rows = self._cell_of(pixels[defies], side)
        self._disparity_px[rows, columns] = reference.landmarks.disparity_px[defies]
        self._cells = self._learnt()
        fixed_px = np.where(self._cells, self._disparity_px, 0)
        self._around_px = np.asarray(cv2.dilate(fixed_px, np.ones((5, 5), np.uint8)), np.float32)

    def _side_px(self, camera: StereoCamera) -> int:
        """Side of a cell."""
        return max(4, -(-camera.width // self._config.cells))

    def _seen_in(self, pixels: NDArray[np.float32], side_px: int) -> NDArray[np.bool_]:
        """Cells in which there is any of these pixels."""
        seen = np.zeros(self._fixed.shape, np.bool_)
        columns, rows = self._cell_of(pixels, side_px)
        seen[rows, columns] = True
        return seen

    def _cell_of(
        self, pixels: NDArray[np.float32], side_px: int
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        columns, rows = (np.rint(pixels).astype(np.intp) // side_px).T
        height, width = self._fixed.shape
        return columns.clip(0, width - 1), rows.clip(0, height - 1)

    def _learnt(self) -> NDArray[np.bool_]:
        """Cells that are fixed: voted so again and again, with their neighbours of some votes."""
        config = self._config
        fixed = self._fixed > 2 * self._moving
        strong = fixed & (self._fixed >= config.votes)
        if not strong.any():
            return strong
        weak = (fixed & (self._fixed >= config.weak_votes)).astype(np.uint8)
        closed = cv2.morphologyEx(weak, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        count, parts, sizes, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
        least = config.least_share * strong.size
        kept = np.zeros(count, np.bool_)
        kept[np.unique(parts[strong])] = True
        kept &= sizes[:, cv2.CC_STAT_AREA] >= least
        kept[0] = False
        return np.asarray(kept[parts], np.bool_)

    def _without(self, frame: Frame, also: NDArray[np.bool_] = _NOTHING) -> Frame:
        """The frame without landmarks in fixed cells, and without some others."""
        if not self._cells.any() and not also.any():
            return frame
        clear = ~also if also.size else np.ones(len(frame.landmarks), np.bool_)
        if self._cells.any():
            side_px = self._side_px(frame.camera)
            columns, rows = self._cell_of(frame.landmarks.pixels, side_px)
            clear &= ~self._cells[rows, columns]
            # Its edges, which get few votes, are as far away as the thing itself.
            off_px = np.abs(frame.landmarks.disparity_px - self._around_px[rows, columns])
            clear &= off_px > self._config.same_disparity_px
        further = frame.further
        if further is not None and self._cells.any():
            further = partial(self._further, frame)
        left_out = int(np.count_nonzero(~clear))
        return replace(_some(frame, clear), left_out=left_out, further=further)

    def _further(self, frame: Frame, count: int) -> Landmarks:
        """Those that the front-end chooses next, without those in fixed cells."""
        assert frame.further is not None
        return self._without(replace(frame, landmarks=frame.further(count), further=None)).landmarks


def kept_rows(before: Frame, now: Frame, config: FixedConfig | None = None) -> NDArray[np.int32]:
    """Which landmark of a frame is at the pixel where another frame has the same one.

    Args:
        before: a frame of N landmarks.
        now: another one of the same camera and kind.
        config: what counts as the same.

    Returns:
        (N,) int32 rows of `now`, -1 where none within a pixel has nearly the same descriptor and
        disparity.
    """
    config = config or FixedConfig()
    return _core.kept_rows(
        features(before), features(now), config.same_bits, config.same_disparity_px
    )


def least_flow_px(
    landmarks: Landmarks, camera: StereoCamera, reference_from_live: SE3
) -> NDArray[np.float64]:
    """How far a motion moves each landmark in the image, at least: as far away as it may be.

    Args:
        landmarks: N landmarks of the reference frame.
        camera: of both frames.
        reference_from_live: pose of the live camera in the reference one.

    Returns:
        (N,) float64, px; infinite behind the live camera.
    """
    sigma_px = landmarks.disparity_sigma_px.astype(np.float64) + _OFFSET_PX
    disparity_px = np.maximum(landmarks.disparity_px - 2 * sigma_px, 0.02)
    depth_m = camera.fx * camera.baseline_m / disparity_px
    u, v = landmarks.pixels.astype(np.float64).T
    points = np.stack(
        [(u - camera.cx) / camera.fx * depth_m, (v - camera.cy) / camera.fy * depth_m, depth_m], 1
    )
    inverse = reference_from_live.inverse()
    x, y, z = (points @ inverse.rotation.T + inverse.translation).T
    ahead = z > 0.05
    z = np.where(ahead, z, 1.0)
    flow = np.hypot(camera.fx * x / z + camera.cx - u, camera.fy * y / z + camera.cy - v)
    return np.where(ahead, flow, np.inf)


def _some(frame: Frame, chosen: NDArray[np.bool_]) -> Frame:
    """The frame with some of its landmarks."""
    return replace(frame, landmarks=frame.landmarks.rows(chosen))


def _there(rows: NDArray[np.int32], count: int) -> NDArray[np.bool_]:
    """(count,) bool, True at some rows."""
    there = np.zeros(count, np.bool_)
    there[rows] = True
    return there


def _comparable(reference: Frame, frame: Frame) -> bool:
    return reference.camera == frame.camera and reference.descriptor == frame.descriptor


def _stands(told: SE3 | None, outside: Guess | None) -> bool:
    """Whether trusted wheels say that the camera stands."""
    if told is None or outside is None or not outside.has_way:
        return False
    return told.distance_m < _LEAST_M and told.angle_rad < _LEAST_RAD


def _rests(told: SE3 | None, outside: Guess | None, motion: SE3) -> bool | None:
    """Whether wheels or gyroscope say that the camera rests; None if they say nothing.

    Args:
        told: the motion since the reference by them; None if not measured.
        outside: what they may be trusted with; None if nothing.
    """
    if told is None or outside is None:
        return None
    if outside.has_way:
        return _is_small(told.distance_m, motion.distance_m, _LEAST_M)
    return _is_small(told.angle_rad, motion.angle_rad, _LEAST_RAD)


def _is_small(told: float, seen: float, least: float) -> bool | None:
    """Whether a motion is much less than what was seen; None if that is too little to decide."""
    return None if seen < least else told < _REST_SHARE * seen
