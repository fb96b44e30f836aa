"""Public data sets, each by a protocol and settings that were fixed before anybody ran it.

    engram lab evaluate public utias ~/data/UTIAS-In-The-Dark
    engram lab evaluate public kitti ~/data/kitti_odometry/dataset

*Repeated drives* (utias, 4seasons, robotcar): the first drive is mapped. Each later one is
localised in that map, and in a map of all drives before it; then it is mapped into the second. *One
drive* (kitti): odometry by KITTI's measure, and the loops that a map of the drive closes. Robots
have the program's defaults, start lost, and are given no truth; truth only judges them.

Drives become frame logs first. A run that was stopped resumes. Untested on the real data.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from engram.cli.settings import AllSettings
from engram.config import to_dict
from engram.errors import InputError, SequenceError
from engram.geometry.se3 import SE3
from engram.graph.model import EdgeKind, NodeId
from engram.maps.map import open_map
from engram.measures import failure
from engram.monitor import QUIET, Monitor
from engram.robot.mapping import extract_log
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import localise_drive, measured
from engram.sequences.layouts import (
    all_numbers,
    is_fourseasons,
    is_kitti_odometry,
    is_robotcar,
    is_utias,
    utias_stamps,
)
from engram.sequences.listing import nanoseconds, read_stamps, seconds_as_ns
from engram.sequences.motion_files import (
    Trajectory,
    finite,
    known_stamp,
    read_kitti_poses,
    read_rows,
    trajectory_of,
)
from engram.sequences.opening import open_drive
from engram.untrusted import read_text
from engram_lab.accuracy import is_false
from engram_lab.studies.building import build_map, edge_errors, write_json
from engram_lab.studies.drives import EvaluatedDrive, drives_of
from engram_lab.studies.evidence import MANIFEST, Manifest
from engram_lab.studies.plan import Row, make_folder, table, write_csv, writing

# A frame of a drive: the drive's name, and the frame's stamp.
At = tuple[str, int]


class Judge(Protocol):
    """The truth of a data set."""

    def node_from_live(self, node: At, live: At) -> SE3 | None:
        """The true pose of one left camera in another; None where it is not known."""
        ...


@dataclass(frozen=True, slots=True)
class InOneWorld:
    """Truth as trajectories in one world frame.

    Attributes:
        paths: of each drive, by its name.
        gap_ns: longest time between two poses that are interpolated.
    """

    paths: Mapping[str, Trajectory]
    gap_ns: int

    def node_from_live(self, node: At, live: At) -> SE3 | None:
        """See `Judge`."""
        world_from_node, world_from_live = self._at(node), self._at(live)
        if world_from_node is None or world_from_live is None:
            return None
        return world_from_node.inverse() @ world_from_live

    def _at(self, frame: At) -> SE3 | None:
        name, stamp_ns = frame
        path = self.paths[name]
        after = int(np.searchsorted(path.stamps_ns, stamp_ns))
        if after < len(path) and path.stamps_ns[after] == stamp_ns:
            return path.world_from_cam[after]
        if not 0 < after < len(path):
            return None
        before_ns, after_ns = (int(path.stamps_ns[k]) for k in (after - 1, after))
        if after_ns - before_ns > self.gap_ns:
            return None
        first, second = path.world_from_cam[after - 1], path.world_from_cam[after]
        share = (stamp_ns - before_ns) / (after_ns - before_ns)
        return first @ SE3.exp(share * (first.inverse() @ second).log())


class TaughtPath:
    """Truth of UTIAS: each frame of a repeated run is tied to a frame of the taught one.

    Rows hold run, frame, the run and frame that these are tied to, and the 4×4 transform of the
    vehicle from the former to the latter. Source: utiasASRL/vtr-dataset-tools, `tools.py`.
    """

    def __init__(self, folder: Path, runs: Sequence[Path]) -> None:
        self._cam_from_vehicle = _matrix(folder / "transform_camera_vehicle.txt")
        self._frames = {
            run.name: {
                stamp_ns: number
                for number, stamp_ns in utias_stamps(run / "timestamps_images.txt").items()
            }
            for run in runs
        }
        taught = read_rows(runs[0] / "transforms_temporal.txt", _tie, ",")
        self._order = {number: at for at, (number, _, _) in enumerate(taught)}
        # Poses of the taught frames in the first one, and the tie from the last one back to it.
        self._first_from: list[SE3] = [SE3.identity()]
        for _, _, next_from_this in taught[:-1]:
            self._first_from.append(self._first_from[-1] @ next_from_this.inverse())
        last = taught[-1]
        self._first_from_last = last[2] if last[1] == taught[0][0] else None
        self._ties: dict[str, dict[int, tuple[int, SE3]]] = {
            runs[0].name: {number: (number, SE3.identity()) for number, _, _ in taught}
        }
        for run in runs[1:]:
            rows = read_rows(run / "transforms_spatial.txt", _tie, ",")
            self._ties[run.name] = {number: (to, pose) for number, to, pose in rows}

    def node_from_live(self, node: At, live: At) -> SE3 | None:
        """See `Judge`; along the path in the shorter direction."""
        tied = [self._tied(*one) for one in (node, live)]
        if tied[0] is None or tied[1] is None:
            return None
        (to_node, taught_from_node), (to_live, taught_from_live) = tied[0], tied[1]
        vehicles = taught_from_node.inverse() @ self._between(to_node, to_live) @ taught_from_live
        return self._cam_from_vehicle @ vehicles @ self._cam_from_vehicle.inverse()

    def _tied(self, run: str, stamp_ns: int) -> tuple[int, SE3] | None:
        number = self._frames[run].get(stamp_ns)
        tie = None if number is None else self._ties[run].get(number)
        return None if tie is None or tie[0] not in self._order else tie

    def _between(self, a: int, b: int) -> SE3:
        """``a_from_b`` of two taught frames."""
        at_a, at_b = self._order[a], self._order[b]
        a_from_first, first_from_b = self._first_from[at_a].inverse(), self._first_from[at_b]
        around = self._first_from_last
        if around is None or abs(at_a - at_b) <= len(self._first_from) / 2:
            return a_from_first @ first_from_b
        first_from_end = self._first_from[-1]
        if at_b > at_a:
            return a_from_first @ around @ first_from_end.inverse() @ first_from_b
        return a_from_first @ first_from_end @ around.inverse() @ first_from_b


def _tie(fields: list[str]) -> tuple[int, int, SE3]:
    """Frame, the frame that it is tied to, and the transform from the one to the other."""
    numbers = finite(fields, 20)
    return int(numbers[1]), int(numbers[3]), SE3.from_matrix(np.array(numbers[4:]).reshape(4, 4))


def _matrix(path: Path) -> SE3:
    try:
        return SE3.from_matrix(all_numbers(path, 16).reshape(4, 4))
    except InputError as error:
        raise SequenceError(f"{path}: {error}; the data set's page has it") from error


def _fourseasons_judge(folder: Path, recordings: Sequence[Path]) -> InOneWorld:
    """Keyframes' poses, in the earth frame of the first recording's surroundings.

    Source: pmwenzel/4seasons-dataset, README: ``transform_e_gpsw @ inv(transform_w_gpsw) @
    transform_S_AS @ scale``.
    """
    del folder
    near = _transformations(recordings[0])["transform_e_gpsw"].inverse()
    return InOneWorld({one.name: _fourseasons_path(one, near) for one in recordings}, 2 * 10**9)


def _fourseasons_path(recording: Path, near_from_earth: SE3) -> Trajectory:
    known = _transformations(recording)
    near_from_slam = (
        near_from_earth
        @ known["transform_e_gpsw"]
        @ known["transform_w_gpsw"].inverse()
        @ known["transform_S_AS"]
    )

    def pose(fields: list[str]) -> tuple[int, SE3]:
        if len(fields) < 9:
            raise ValueError(f"{len(fields)} values, must be at least 9")
        stamp_ns = known_stamp(nanoseconds(fields[0].strip()))
        x, y, z, qx, qy, qz, qw, scale = finite(fields[1:9], 8)
        placed = SE3.from_quaternion([qw, qx, qy, qz], scale * np.array([x, y, z]))
        return stamp_ns, near_from_slam @ placed

    path = recording / "GNSSPoses.txt"
    lines = [line for line in read_text(path).splitlines() if line[:1].isdigit()]
    return trajectory_of(path, sorted((pose(line.split(",")) for line in lines), key=_stamp))


def _stamp(one: tuple[int, SE3]) -> int:
    return one[0]


def _transformations(recording: Path) -> dict[str, SE3]:
    """The transforms of `Transformations.txt` by name: a line of its name, one of its values."""
    path = recording / "Transformations.txt"
    lines = [line.strip() for line in read_text(path).splitlines() if line.strip()]
    found: dict[str, SE3] = {}
    for head, values in pairwise(lines):
        if head.startswith("# transform_"):
            x, y, z, qx, qy, qz, qw = finite(values.split(","), 7)
            found[head[2:].partition(":")[0]] = SE3.from_quaternion([qw, qx, qy, qz], [x, y, z])
    for name in ("transform_S_AS", "transform_w_gpsw", "transform_e_gpsw"):
        if name not in found:
            raise SequenceError(f"{path}: {name} is missing")
    return found


def _robotcar_judge(folder: Path, traversals: Sequence[Path]) -> InOneWorld:
    """RTK poses of the inertial sensor, carried to the wide left camera.

    `rtk.csv` stands in a traversal, or in `rtk/TRAVERSAL/` of the folder; `extrinsics/` of the
    software kit in the folder. Source: its `interpolate_poses.py`, `build_pointcloud.py`.
    """
    extrinsics = folder / "extrinsics"
    vehicle_from_ins = _xyzrpy(all_numbers(extrinsics / "ins.txt", 6))
    stereo_from_vehicle = _xyzrpy(all_numbers(extrinsics / "stereo.txt", 6))
    model = folder / "models" / "stereo_wide_left.txt"
    numbers = [float(text) for text in read_text(model).split()[4:20]]
    stereo_from_image = SE3.from_matrix(np.array(numbers).reshape(4, 4))
    ins_from_cam = vehicle_from_ins.inverse() @ stereo_from_vehicle.inverse() @ stereo_from_image
    found = {one.name: _rtk(folder, one, ins_from_cam) for one in traversals}
    # In metres from the first pose: map coordinates have seven digits before the point.
    origin = SE3(np.eye(3), next(iter(found.values())).world_from_cam[0].translation).inverse()
    paths = {
        name: Trajectory(path.stamps_ns, [origin @ one for one in path.world_from_cam])
        for name, path in found.items()
    }
    return InOneWorld(paths, 10**9)


def _rtk(folder: Path, traversal: Path, ins_from_cam: SE3) -> Trajectory:
    """North, east, down."""
    places = (traversal / "rtk.csv", traversal / "gps/rtk.csv", folder / "rtk" / traversal.name)
    path = next((one for one in places if one.is_file()), places[-1] / "rtk.csv")
    poses: dict[int, SE3] = {}
    for number, row in enumerate(csv.DictReader(read_text(path).splitlines()), start=2):
        try:
            names = ("northing", "easting", "down", "roll", "pitch", "yaw")
            values = np.array(finite([row[name] for name in names], 6))
            poses[1000 * int(row["timestamp"])] = _xyzrpy(values) @ ins_from_cam
        except (LookupError, ValueError, TypeError, InputError) as error:
            raise SequenceError(f"{path}: line {number}: {error}") from error
    return trajectory_of(path, sorted(poses.items(), key=_stamp))


def _xyzrpy(values: NDArray[np.float64]) -> SE3:
    """Position and roll, pitch, yaw: turned about x, then y, then z."""
    roll, pitch, yaw = (
        SE3.exp([0.0, 0.0, 0.0, *(angle * axis)])
        for angle, axis in zip(values[3:], np.eye(3), strict=True)
    )
    return SE3((yaw @ pitch @ roll).rotation, values[:3])


def _kitti_judge(folder: Path, sequences: Sequence[Path]) -> InOneWorld:
    paths = {}
    for one in sequences:
        stamps_ns = read_stamps(one / "times.txt", seconds_as_ns)
        paths[one.name] = read_kitti_poses(folder / "poses" / f"{one.name}.txt", stamps_ns)
    return InOneWorld(paths, 0)


def _below(is_one: Callable[[Path], bool]) -> Callable[[Path], list[Path]]:
    """Finds drives up to two folders below, by name: public names are dates or numbers."""

    def found(folder: Path) -> list[Path]:
        deep = sorted(
            one
            for pattern in ("*", "*/*")
            for one in folder.glob(pattern)
            if one.is_dir() and is_one(one)
        )
        return sorted(deep, key=lambda one: one.name)

    return found


def _with_truth(folder: Path) -> list[Path]:
    found = sorted(one for one in (folder / "sequences").glob("*") if is_kitti_odometry(one))
    return [one for one in found if (folder / "poses" / f"{one.name}.txt").is_file()]


@dataclass(frozen=True, slots=True)
class PublicSet:
    """A data set and its protocol.

    Attributes:
        drives: finds its drives below a folder, the first one first.
        judge: its truth, from the folder and the drives.
        repeated: whether the drives repeat a route; else each is studied by itself.
    """

    title: str
    drives: Callable[[Path], list[Path]]
    judge: Callable[[Path, Sequence[Path]], Judge]
    repeated: bool = True


PUBLIC: Mapping[str, PublicSet] = {
    "utias": PublicSet(
        "UTIAS Long-Term Localization and Mapping (In the Dark or Multiseason)",
        _below(is_utias),
        TaughtPath,
    ),
    "4seasons": PublicSet(
        "4Seasons, recordings of one route", _below(is_fourseasons), _fourseasons_judge
    ),
    "robotcar": PublicSet("Oxford RobotCar with RTK", _below(is_robotcar), _robotcar_judge),
    "kitti": PublicSet("KITTI odometry, whole", _with_truth, _kitti_judge, repeated=False),
}


@dataclass(frozen=True, slots=True)
class PublicStudy:
    """A data set on this machine, and where its results go.

    Attributes:
        out: logs, maps, rows, table and page.
    """

    name: str
    folder: Path
    out: Path
    settings: Settings
    options: RobotOptions = field(default_factory=RobotOptions)

    @property
    def set(self) -> PublicSet:
        """The protocol."""
        return PUBLIC[self.name]

    def run(self, monitor: Monitor = QUIET) -> Path:
        """Runs what is missing; the page.

        Raises:
            SequenceError: the folder holds no drives of this set, or their truth cannot be read.
        """
        found = self.set.drives(self.folder)
        least = 2 if self.set.repeated else 1
        if len(found) < least:
            raise SequenceError(
                f"{self.folder}: {len(found)} drives of {self.set.title}, must be at least {least}"
            )
        names = [one.name for one in found]
        if twice := [one for one in found if names.count(one.name) > 1]:
            raise SequenceError(
                f"{' and '.join(map(str, twice))}: drives of one name; leave one there"
            )
        judge = self.set.judge(self.folder, found)
        make_folder(self.out)
        with writing(self.out):
            drives = [self._logged(one, monitor) for one in found]
            judged = _Judged(self, drives, judge)
            rows = judged.repeated() if self.set.repeated else judged.alone()
            return self._report(list(rows))

    def _logged(self, path: Path, monitor: Monitor) -> EvaluatedDrive:
        """The drive as a frame log, by its folder's name."""
        log = self.out / f"{path.name}.framelog"
        record = self.out / f"{path.name}.recorded.json"
        if not (log.exists() and record.exists()):
            drive = open_drive(path, robot=self.name, skip_bad=True)
            with monitor.stage(f"record {path.name}", len(drive)) as part:
                report = extract_log(drive, log, self.settings, part)
            if report.interrupted:
                raise KeyboardInterrupt
            write_json(record, {"frames": len(drive), "skipped": drive.skipped})
        (found,) = drives_of([log])
        return found

    def _report(self, rows: list[Row]) -> Path:
        command = f"engram lab evaluate public {self.name} {self.folder.name}"
        manifest = replace(Manifest.now(self.name, (command,)), ran=1)
        write_json(self.out / MANIFEST, to_dict(manifest))
        write_csv(self.out / "rows.csv", rows)
        page = self.out / "page.md"
        about = " ".join((__doc__ or "").split("\n\n")[2].split())
        lines = [
            f"# {self.set.title}",
            "",
            about.replace("``", "`"),
            "",
            f"Method {manifest.method}, `{self.settings.frontend.descriptor}`, program "
            f"{manifest.engram} {manifest.source}; {manifest.machine}.",
            "",
            *table(rows),
        ]
        page.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return page


@dataclass(frozen=True)  # no slots: it remembers whose sessions are whose
class _Judged:
    """The drives of a set, run and judged."""

    study: PublicStudy
    drives: Sequence[EvaluatedDrive]
    judge: Judge

    @cached_property
    def _names(self) -> dict[Any, str]:
        return {one.session.id: one.name for one in self.drives}

    def repeated(self) -> Iterator[Row]:
        """Each drive but the first, in both maps."""
        first, grown = (self.study.out / f"{name}.engram" for name in ("first", "all"))
        self._build(first, self.drives[:1])
        for count in range(1, len(self.drives)):
            live = self.drives[count]
            record = self.study.out / f"{live.name}.rows.json"
            if not record.exists():
                self._build(grown, self.drives[:count])
                maps = (("first", first), ("all before", grown))
                write_json(record, [self._row(live, name, path) for name, path in maps])
            yield from json.loads(record.read_text(encoding="utf-8"))

    def alone(self) -> Iterator[Row]:
        """Odometry and loops of each drive by itself."""
        for drive in self.drives:
            record = self.study.out / f"{drive.name}.rows.json"
            if not record.exists():
                path = self.study.out / f"{drive.name}.engram"
                self._build(path, [drive])
                write_json(record, [{"drive": drive.name} | self._drift(drive) | self._loops(path)])
            yield from json.loads(record.read_text(encoding="utf-8"))

    def _build(self, path: Path, drives: Sequence[EvaluatedDrive]) -> None:
        build_map(path, drives, self.study.settings, self.study.options)

    def _row(self, live: EvaluatedDrive, name: str, path: Path) -> Row:
        """A drive localised in a map."""
        errors: list[tuple[float, float]] = []
        with open_map(path) as opened, closing(live.log()) as log:
            results = localise_drive(opened, log, self.study.settings, self.study.options)
            at = {one.id: (self._names[one.session], one.stamp_ns) for one in opened.graph.nodes}
            for one in results:
                if one.node is not None and one.node_from_live is not None:
                    true = self.judge.node_from_live(at[one.node], (live.name, one.stamp_ns))
                    if true is not None:
                        errors.append(_error(one.node_from_live, true))
            nodes = opened.node_count()
        drive = measured(results)
        driven_m = float(drive.step_m.sum())
        missed_m = float(drive.step_m[~drive.matched].sum())
        return {
            "drive": live.name,
            "map": name,
            "nodes": nodes,
            "frames": len(results),
            "driven_m": round(driven_m, 1),
            "share_localised": float(drive.matched.mean()),
            "share_not_localised": missed_m / driven_m if driven_m else 0.0,
            "p_gt_10m": float(failure([drive], 10.0)),
            "fixes_judged": len(errors),
            "false_fixes": sum(is_false(*one) for one in errors),
            "median_error_m": float(np.median([one[0] for one in errors])) if errors else None,
            "p95_error_m": float(np.quantile([one[0] for one in errors], 0.95)) if errors else None,
        }

    def _drift(self, drive: EvaluatedDrive) -> Row:
        """KITTI's measure: mean error over 100, 200, … 800 m ÷ length, from every tenth frame."""
        poses, true = [SE3.identity()], []
        first: At | None = None
        with closing(drive.log()) as log:
            for number, one in enumerate(log):
                step = one.odometry.prev_from_curr
                if number:
                    poses.append(poses[-1] @ (SE3.identity() if step is None else step))
                live = (drive.name, one.frame.stamp_ns)
                first = first or live
                true.append(self.judge.node_from_live(first, live))
        known = [pose for pose in true if pose is not None]
        if len(known) != len(true):
            raise SequenceError(f"{drive.name}: {len(true) - len(known)} frames have no true pose")
        return kitti_drift(poses, known)

    def _loops(self, path: Path) -> Row:
        """Match edges of a map of one drive, and those of them that join two places."""
        with open_map(path) as opened:
            at = {one.id: (self._names[one.session], one.stamp_ns) for one in opened.graph.nodes}
            first = at[opened.graph.nodes[0].id]
            pose = partial(self._pose, at, first)
            matches = [
                one for one in edge_errors(opened.graph.edges, pose) if one.kind is EdgeKind.MATCH
            ]
            nodes = opened.node_count()
        return {
            "nodes": nodes,
            "loop_edges": len(matches),
            "join_two_places": sum(one.joins_places for one in matches),
        }

    def _pose(self, at: Mapping[NodeId, At], first: At, node: NodeId) -> SE3 | None:
        return self.judge.node_from_live(first, at[node])


def _error(found: SE3, true: SE3) -> tuple[float, float]:
    """Metres and radians."""
    offset_m = float(np.linalg.norm(found.translation - true.translation))
    return offset_m, (true.inverse() @ found).angle_rad


_STRETCHES_M = np.arange(100.0, 900.0, 100.0)


def kitti_drift(
    poses: Sequence[SE3], true: Sequence[SE3], stretches_m: NDArray[np.float64] = _STRETCHES_M
) -> Row:
    """KITTI's odometry measure.

    Source: Geiger, Lenz, Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark
    suite", CVPR 2012, and its development kit.

    Args:
        poses, true: of each frame, in that of the first.
    """
    steps = [(a.inverse() @ b).distance_m for a, b in pairwise(true)]
    driven_m = np.concatenate([[0.0], np.cumsum(steps)])
    shares, turns = [], []
    for start in range(0, len(true), 10):
        for length_m in stretches_m:
            end = int(np.searchsorted(driven_m, driven_m[start] + length_m))
            if end < len(true):
                wanted = true[start].inverse() @ true[end]
                off = (poses[start].inverse() @ poses[end]).inverse() @ wanted
                shares.append(off.distance_m / length_m)
                turns.append(np.rad2deg(off.angle_rad) / length_m)
    return {
        "frames": len(true),
        "driven_m": round(float(driven_m[-1]), 1),
        "drift_percent": 100 * float(np.mean(shares)) if shares else None,
        "drift_deg_per_m": float(np.mean(turns)) if turns else None,
    }


def study_of(name: str, folder: Path, out: Path, kind: str) -> PublicStudy:
    """A public set by name, with the program's defaults for a kind of features."""
    if name not in PUBLIC:
        raise InputError(f"no public set {name!r}; there are {', '.join(PUBLIC)}")
    return PublicStudy(name, folder, out, AllSettings().of_robot(kind))
