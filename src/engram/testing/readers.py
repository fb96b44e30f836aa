"""What every reader of drives must do, checked on a small drive that its author writes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.errors import EngramError, SequenceError
from engram.frontend import StereoPair
from engram.geometry import StereoCamera
from engram.sequences import (
    Drive,
    FrameLog,
    FrameRange,
    LoggedFrame,
    OpenOptions,
    SequenceFormat,
    first_pair_hash,
    layout_named,
    layout_names,
    session_of,
)
from engram.sequences.images import IMAGE_SUFFIXES
from engram.testing.checks import Check

# Writes a drive of these pairs below an empty folder and returns the path that users name.
WriteDrive: TypeAlias = Callable[[Path, Sequence[StereoPair]], Path]

_CAMERA = StereoCamera(40.0, 40.0, 23.5, 15.5, 0.1, 48, 32)
_PAIRS, _START_NS, _PERIOD_NS = 6, 1_400_000_000_000_000_000, 100_000_000
# Stamps may be stored as decimal seconds.
_SAME_STAMP_NS = 1_000
# Rectification crops and bends, least in the middle; other images correlate far less there.
_ALIKE = 0.5
_SAME_CAMERA = 0.05


def check_reader(
    name: str, layout: SequenceFormat, write: WriteDrive, *, writes_camera: bool = True
) -> list[Check]:
    """Runs a reader on small drives of its layout; a fraction of a second.

    What concerns image files is left out for layouts without any.

    Args:
        name: the layout's name, as its entry point states it.
        layout: the reader.
        write: writes pairs in that layout: an empty folder, the pairs → the path that users name.
        writes_camera: whether `write` also stores the pairs' camera, which the reader must find.
    """
    with TemporaryDirectory() as folder:
        trial = _Trial(name, layout, write, Path(folder), writes_camera=writes_camera)
        return list(trial.checks())


class _Trial:
    def __init__(
        self,
        name: str,
        layout: SequenceFormat,
        write: WriteDrive,
        folder: Path,
        *,
        writes_camera: bool,
    ) -> None:
        self._name, self._layout, self._write, self._folder = name, layout, write, folder
        self._writes_camera = writes_camera
        self._pairs = [_pair(index) for index in range(_PAIRS)]
        self._drive = self._written("drive")

    def checks(self) -> Iterator[Check]:
        yield _checked("it is recognised by its names, and as no other layout", self._recognition)
        yield _checked("other files and folders are not taken for it", self._others)
        all_come = _checked("all pairs come, with their stamps", self._stamps)
        yield all_come
        yield _checked("--frames is a slice", self._slice)
        if not all_come.met or isinstance(self._open(self._drive), FrameLog):
            return
        yield _checked("images are (h, w) uint8 of the camera's size, left is left", self._images)
        yield _checked("the camera is the one that was written", self._camera)
        yield _checked("reading twice gives one session", self._session)
        if self._image_files(self._drive):
            yield _checked("a damaged image is an error that names the file", self._damaged)
            yield _checked("--skip-bad leaves out a damaged pair and counts it", self._skipped)
            yield _checked("a missing image costs its own pair", self._missing)

    def _written(self, name: str) -> Path:
        folder = self._folder / name
        folder.mkdir()
        return self._write(folder, self._pairs)

    def _open(self, path: Path, frames: str = "0::1", *, skip_bad: bool = False) -> Drive:
        options = OpenOptions(frames=FrameRange.parse(frames), skip_bad=skip_bad)
        return self._layout.open(path, options)

    def _recognition(self) -> str:
        if not self._layout.recognises(self._drive):
            return f"{self._drive.name} is not recognised"
        others = [name for name in layout_names() if name != self._name]
        found = [name for name in others if layout_named(name).recognises(self._drive)]
        return f"also recognised as {', '.join(found)}" if found else ""

    def _others(self) -> str:
        empty, note = self._folder / "empty", self._folder / "note.txt"
        empty.mkdir()
        note.write_text("no drive")
        taken = [
            path.name
            for path in (empty, note, self._folder / "nowhere")
            if self._layout.recognises(path)
        ]
        return f"{taken[0]} is taken for a drive" if taken else ""

    def _stamps(self) -> str:
        drive = self._open(self._drive)
        if drive.info.format != self._name:
            return f"info.format is {drive.info.format!r}, must be {self._name!r}"
        return _not_these(_stamps_of(drive), range(_PAIRS))

    def _slice(self) -> str:
        return _not_these(_stamps_of(self._open(self._drive, "1:6:2")), (1, 3, 5), first=1)

    def _images(self) -> str:
        drive = self._open(self._drive)
        size = (drive.camera.height, drive.camera.width)
        for index, (read, written) in enumerate(zip(_pairs_of(drive), self._pairs, strict=True)):
            for side, other in (("left", "right"), ("right", "left")):
                image = getattr(read, side)
                if image.dtype != np.uint8 or image.shape != size:
                    return f"{side} image {index} is {image.shape} {image.dtype}, must be {size}"
                own = _likeness(image, getattr(written, side))
                if own < _ALIKE or _likeness(image, getattr(written, other)) > own:
                    return f"{side} image {index} is another one (likeness {own:.2f})"
        return ""

    def _camera(self) -> str:
        found = self._open(self._drive).camera
        for name in ("fx", "fy", "baseline_m") if self._writes_camera else ():
            wanted, value = getattr(_CAMERA, name), getattr(found, name)
            if abs(value - wanted) > _SAME_CAMERA * wanted:
                return f"{name} is {value:g}, must be {wanted:g}"
        return ""

    def _session(self) -> str:
        sessions = set()
        for _ in range(2):
            drive = self._open(self._drive)
            first = _pairs_of(drive)[0]
            hashed = first_pair_hash(first)
            sessions.add(session_of(drive.info, drive.camera, first.stamp_ns, hashed).id)
        return "" if len(sessions) == 1 else "two sessions"

    def _damaged(self) -> str:
        path, image = self._spoilt("damaged")
        image.write_bytes(image.read_bytes()[:20])
        try:
            _stamps_of(self._open(path))
        except SequenceError as error:
            return "" if image.name in str(error) else f"{image.name} is not in: {error}"
        return "no SequenceError"

    def _skipped(self) -> str:
        path, image = self._spoilt("skipped")
        image.write_bytes(image.read_bytes()[:20])
        drive = self._open(path, skip_bad=True)
        read = len(_stamps_of(drive))
        good = (read, drive.skipped) == (_PAIRS - 1, 1)
        return "" if good else f"{read} pairs, {drive.skipped} skipped"

    def _missing(self) -> str:
        path, image = self._spoilt("missing")
        image.unlink()
        read = len(_stamps_of(self._open(path, skip_bad=True)))
        return "" if read == _PAIRS - 1 else f"{read} of {_PAIRS} pairs are left"

    def _spoilt(self, name: str) -> tuple[Path, Path]:
        """Another drive, and one of its images to spoil: of the left side if that sorts first."""
        path = self._written(name)
        files = self._image_files(path)
        return path, files[len(files) // 4]

    @staticmethod
    def _image_files(path: Path) -> list[Path]:
        return sorted(one for one in path.rglob("*") if one.suffix.lower() in IMAGE_SUFFIXES)


def _checked(demand: str, fault: Callable[[], str]) -> Check:
    try:
        text = fault()
    except EngramError as error:
        text = str(error)
    return Check(demand, not text, text or "yes")


def _stamps_of(drive: Drive) -> NDArray[np.int64]:
    frames = (one.frame if isinstance(one, LoggedFrame) else one for one in drive)
    return np.array([one.stamp_ns for one in frames], np.int64)


def _pairs_of(drive: Drive) -> list[StereoPair]:
    return [one for one in drive if isinstance(one, StereoPair)]


def _not_these(stamps_ns: NDArray[np.int64], wanted: Sequence[int], first: int = 0) -> str:
    """How stamps differ from those of the pairs `wanted`; the clock may begin anywhere."""
    if len(stamps_ns) != len(wanted):
        return f"{len(stamps_ns)} pairs, must be {len(wanted)}"
    expected_ns = _PERIOD_NS * (np.array(wanted) - first)
    off_ns = np.abs(stamps_ns - stamps_ns[0] - expected_ns)
    worst = int(off_ns.argmax())
    return "" if off_ns[worst] <= _SAME_STAMP_NS else f"pair {worst} is {off_ns[worst]} ns off"


def _likeness(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    """Correlation of the middle halves of two (h, w) images."""
    rows, columns = (slice(size // 4, -size // 4) for size in one.shape)
    return float(np.corrcoef(one[rows, columns].ravel(), other[rows, columns].ravel())[0, 1])


def _pair(index: int) -> StereoPair:
    left, right = (_picture(index, side) for side in range(2))
    return StereoPair(_START_NS + index * _PERIOD_NS, left, right, _CAMERA)


def _picture(index: int, side: int) -> NDArray[np.uint8]:
    """(32, 48) uint8 clouds, others for every pair and side."""
    draws = np.random.default_rng([index, side])
    noise = draws.standard_normal((_CAMERA.height, _CAMERA.width), np.float32)
    clouds = cv2.GaussianBlur(noise, (0, 0), 3)
    scaled = 128 + 50 * (clouds - clouds.mean()) / clouds.std()
    return np.asarray(np.clip(np.rint(scaled), 0, 255), np.uint8)
