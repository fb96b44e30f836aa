"""Public sets: rendered drives in copies of their layouts, truth included, come out right."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.cli.conftest import engram

from engram.errors import InputError, SequenceError
from engram.geometry.se3 import SE3
from engram.sample.drives import write_drives
from engram.sequences.motion_files import Trajectory, read_tum
from engram.sequences.opening import open_drive
from engram_lab.studies.public import PUBLIC, InOneWorld, TaughtPath, kitti_drift, study_of

__all__ = ["engram"]

NAMES = ("monday", "tuesday")
# The sample drives' focal length and centre, px; UTIAS's camera is another.
FOCAL_PX, CENTRE_PX = 401.8395077420775, (255.5, 191.5)
UTIAS_PX, UTIAS_CENTRE_PX = 387.777, (257.446, 197.718)
# Any mounting: where the camera is on a vehicle whose x points forwards.
CAM_FROM_VEHICLE = SE3(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.1, 1.2, -0.4])
) @ SE3.exp([0.0, 0.0, 0.0, 0.02, -0.03, 0.01])


@pytest.fixture(scope="module")
def sample(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sample")
    write_drives(folder)
    return folder


def pairs_of(sample: Path, name: str) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    for pair in open_drive(sample / name):
        yield pair.stamp_ns, pair.left, pair.right


def truth_of(sample: Path, name: str) -> Trajectory:
    return read_tum(sample / f"{name}.truth.txt")


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def numbers(pose: SE3, rows: int = 4) -> str:
    return " ".join(f"{one:.9f}" for one in pose.matrix()[:rows].ravel())


def as_utias(sample: Path, folder: Path) -> None:
    """Monday is taught; each frame of Tuesday is tied to Monday's nearest."""
    scale = UTIAS_PX / FOCAL_PX
    shift = np.array(UTIAS_CENTRE_PX) - scale * np.array(CENTRE_PX)
    view = np.column_stack([scale * np.eye(2), shift])
    worlds = [truth_of(sample, name).world_from_cam for name in NAMES]
    vehicles = [[one @ CAM_FROM_VEHICLE for one in world] for world in worlds]
    for run, name in enumerate(NAMES):
        path = folder / f"run_{run:06d}"
        lines = []
        for number, (stamp_ns, left, right) in enumerate(pairs_of(sample, name)):
            for side, image in (("left", left), ("right", right)):
                moved = cv2.warpAffine(image, view, (512, 384), borderMode=cv2.BORDER_REFLECT)
                write(path / "images" / side / f"{number:06d}.png", moved)
            lines.append(f"{number},{stamp_ns}")
        (path / "timestamps_images.txt").write_text("\n".join(lines) + "\n")
    first, second = vehicles

    def row(run: int, number: int, to: int, pose: SE3) -> str:
        return ",".join([str(run), str(number), "0", str(to), *numbers(pose).split()])

    taught = [
        row(0, number, number + 1, first[number + 1].inverse() @ first[number])
        for number in range(len(first) - 1)
    ]
    (folder / "run_000000" / "transforms_temporal.txt").write_text("\n".join(taught) + "\n")
    tied = []
    for number, vehicle in enumerate(second):
        near = min(range(len(taught)), key=lambda k: (first[k].inverse() @ vehicle).distance_m)
        tied.append(row(1, number, near, first[near].inverse() @ vehicle))
    (folder / "run_000001" / "transforms_spatial.txt").write_text("\n".join(tied) + "\n")
    (folder / "transform_camera_vehicle.txt").write_text(numbers(CAM_FROM_VEHICLE) + "\n")


def quaternion_row(pose: SE3) -> str:
    w, x, y, z = pose.quaternion_wxyz()
    return ",".join(f"{one:.12f}" for one in (*pose.translation, x, y, z, w))


def as_fourseasons(sample: Path, folder: Path) -> None:
    """Each recording has a world and a scale of its own; the earth is what they share."""
    calibration = folder / "calibration"
    calibration.mkdir(parents=True)
    line = f"Pinhole {FOCAL_PX} {FOCAL_PX} {CENTRE_PX[0]} {CENTRE_PX[1]} 0 0 0 0\n512 384\n"
    for number in (0, 1):
        (calibration / f"undistorted_calib_{number}.txt").write_text(line)
    stereo = np.eye(4)
    stereo[0, 3] = -0.24
    np.savetxt(calibration / "undistorted_calib_stereo.txt", stereo)
    earth_from_town = SE3.exp([4e6, 8e5, 4.7e6, 0.4, -0.8, 0.3])
    for seed, name in enumerate(NAMES):
        path = folder / f"recording_2020-0{seed + 3}-24_17-36-22"
        for stamp_ns, left, right in pairs_of(sample, name):
            write(path / "undistorted_images" / "cam0" / f"{stamp_ns}.png", left)
            write(path / "undistorted_images" / "cam1" / f"{stamp_ns}.png", right)
        draws = np.random.default_rng(seed)
        world_from_gps, metric_from_slam = (SE3.exp(draws.normal(size=6)) for _ in range(2))
        # ECEF = e_gpsw · w_gpsw⁻¹ · S_AS · (scaled pose), with e_gpsw the same for both.
        slam_from_town = metric_from_slam.inverse() @ world_from_gps
        scale = 0.8 + 0.3 * seed
        truth = truth_of(sample, name)
        lines = ["#frame_id,tx,ty,tz,qx,qy,qz,qw,scale,fusion_quality,v3"]
        for stamp_ns, pose in zip(truth.stamps_ns, truth.world_from_cam, strict=True):
            placed = slam_from_town @ pose
            shrunk = SE3(placed.rotation, placed.translation / scale)
            lines.append(f"{stamp_ns},{quaternion_row(shrunk)},{scale},1.0,0")
        (path / "GNSSPoses.txt").write_text("\n".join(lines[:2] + lines[3:]) + "\n")
        parts = {
            "transform_S_AS": metric_from_slam,
            "TS_cam_imu": SE3.identity(),
            "transform_w_gpsw": world_from_gps,
            "transform_gps_imu": SE3.identity(),
            "transform_e_gpsw": earth_from_town,
        }
        text = "".join(
            f"# {one}: translation vector, rotation quaternion\n{quaternion_row(pose)}\n\n"
            for one, pose in parts.items()
        )
        (path / "Transformations.txt").write_text(text + "# GNSS scale\n0.969397\n")


def euler(rotation: np.ndarray) -> tuple[float, float, float]:
    return (
        float(np.arctan2(rotation[2, 1], rotation[2, 2])),
        float(-np.arcsin(rotation[2, 0])),
        float(np.arctan2(rotation[1, 0], rotation[0, 0])),
    )


def as_robotcar(sample: Path, folder: Path) -> None:
    """Raw images that the tables leave as they are; RTK of an inertial sensor on the roof."""
    vehicle_from_ins = SE3.exp([-1.7, 0.1, 1.2, -0.01, 0.04, 0.005])
    stereo_from_vehicle = SE3.exp([0.1, 0.2, -0.1, 0.0, 0.01, 0.02])
    stereo_from_image = SE3(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.zeros(3))
    cam_from_ins = stereo_from_image.inverse() @ stereo_from_vehicle @ vehicle_from_ins
    (folder / "models").mkdir(parents=True)
    columns, rows = np.meshgrid(np.arange(512.0), np.arange(384.0))
    table = np.stack([columns, rows]).astype("<f8").tobytes()
    for name in ("stereo_wide_left", "stereo_wide_right"):
        head = f"{FOCAL_PX} {FOCAL_PX} {CENTRE_PX[0]} {CENTRE_PX[1]}\n"
        (folder / "models" / f"{name}.txt").write_text(head + numbers(stereo_from_image) + "\n")
        (folder / "models" / f"{name}_distortion_lut.bin").write_bytes(table)
    (folder / "extrinsics").mkdir()
    for name, pose in (("ins", vehicle_from_ins), ("stereo", stereo_from_vehicle)):
        values = (*pose.translation, *euler(pose.rotation))
        (folder / "extrinsics" / f"{name}.txt").write_text(" ".join(map(str, values)))
    far = SE3(SE3.exp([0, 0, 0, 0.0, 0.0, 0.5]).rotation, np.array([5.7e6, 6.2e5, -110.0]))
    for day, name in enumerate(NAMES):
        path = folder / f"2014-05-1{day}-13-20-57"
        for stamp_ns, left, right in pairs_of(sample, name):
            for side, image in (("left", left), ("right", right)):
                write(path / "stereo" / side / f"{stamp_ns // 1000}.png", image)
        truth = truth_of(sample, name)
        lines = ["timestamp,latitude,longitude,northing,easting,down,roll,pitch,yaw"]
        for stamp_ns, pose in zip(truth.stamps_ns, truth.world_from_cam, strict=True):
            ins = far @ pose @ cam_from_ins
            values = (stamp_ns // 1000, 51.7, -1.26, *ins.translation, *euler(ins.rotation))
            lines.append(",".join(map(str, values)))
        rtk = path / "rtk.csv" if day else folder / "rtk" / path.name / "rtk.csv"
        rtk.parent.mkdir(parents=True, exist_ok=True)
        rtk.write_text("\n".join(lines) + "\n")


COPIES = {"utias": as_utias, "4seasons": as_fourseasons, "robotcar": as_robotcar}


@pytest.fixture(scope="module", params=COPIES)
def copied(request, sample: Path, tmp_path_factory) -> tuple[str, Path]:
    folder = tmp_path_factory.mktemp("copies") / request.param
    COPIES[request.param](sample, folder)
    return request.param, folder


def test_every_set_of_repeated_drives_has_a_copy() -> None:
    assert set(COPIES) == {name for name, one in PUBLIC.items() if one.repeated}


def test_truth_is_that_of_the_rendered_drives(copied, sample: Path) -> None:
    name, folder = copied
    found = PUBLIC[name].drives(folder)
    judge = PUBLIC[name].judge(folder, found)
    paths = [truth_of(sample, one) for one in NAMES]
    checked = 0
    for at in range(12, 30):
        # Monday is taught but for its last frame, and what RTK has is in microseconds.
        node, live = paths[0].world_from_cam[at], paths[1].world_from_cam[at - 8]
        stamps = [int(paths[0].stamps_ns[at]), int(paths[1].stamps_ns[at - 8])]
        if name == "robotcar":
            stamps = [one // 1000 * 1000 for one in stamps]
        true = node.inverse() @ live
        told = judge.node_from_live((found[0].name, stamps[0]), (found[1].name, stamps[1]))
        assert told is not None
        assert np.linalg.norm(told.translation - true.translation) < 1e-4
        assert (told.inverse() @ true).angle_rad < 1e-5
        checked += 1
    assert checked == 18


@pytest.mark.parametrize(
    "copied",
    [name if name == "utias" else pytest.param(name, marks=pytest.mark.long) for name in COPIES],
    indirect=True,
)
def test_one_command_makes_one_page(copied, engram, tmp_path: Path) -> None:
    name, folder = copied
    out = tmp_path / "out"
    ran = engram("lab", "evaluate", "public", name, folder, "--out", out)
    assert ran.status == 0, ran.err
    assert ran.out.startswith(f"# {PUBLIC[name].title}")
    with (out / "rows.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [one["map"] for one in rows] == ["first", "all before"]
    for row in rows:
        assert float(row["share_localised"]) > 0.5
        assert int(row["fixes_judged"]) >= 20
        assert int(row["false_fixes"]) == 0
        assert float(row["median_error_m"]) < 0.06
    before = {path: path.stat().st_mtime_ns for path in out.glob("*.framelog")}
    again = engram("lab", "evaluate", "public", name, folder, "--out", out, "--json")
    assert again.json["page"] == str(out / "page.md")
    assert {path: path.stat().st_mtime_ns for path in out.glob("*.framelog")} == before


def as_kitti(sample: Path, folder: Path) -> None:
    path = folder / "sequences" / "03"
    truth = truth_of(sample, "monday")
    first = truth.world_from_cam[0].inverse()
    stamps = []
    for number, (stamp_ns, left, right) in enumerate(pairs_of(sample, "monday")):
        for side, image in ((0, left), (1, right)):
            write(path / f"image_{side}" / f"{number:06d}.png", image)
        stamps.append(f"{(stamp_ns - int(truth.stamps_ns[0])) / 1e9:e}")
    (path / "times.txt").write_text("\n".join(stamps) + "\n")
    row = f"{FOCAL_PX} 0 {CENTRE_PX[0]} {{}} 0 {FOCAL_PX} {CENTRE_PX[1]} 0 0 0 1 0"
    (path / "calib.txt").write_text(f"P0: {row.format(0)}\nP1: {row.format(-0.24 * FOCAL_PX)}\n")
    poses = [numbers(first @ one, rows=3) for one in truth.world_from_cam]
    (folder / "poses").mkdir()
    (folder / "poses" / "03.txt").write_text("\n".join(poses) + "\n")


def test_kitti_is_studied_drive_by_drive(sample: Path, engram, tmp_path: Path) -> None:
    as_kitti(sample, tmp_path / "kitti")
    (tmp_path / "kitti/sequences/11/image_0").mkdir(parents=True)  # of the test part: no truth
    out = tmp_path / "out"
    ran = engram("lab", "evaluate", "public", "kitti", tmp_path / "kitti", "--out", out)
    assert ran.status == 0, ran.err
    with (out / "rows.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["drive"] == "03"
    assert int(row["frames"]) == 40
    assert int(row["join_two_places"]) == 0


def straight(metres: float) -> SE3:
    return SE3(np.eye(3), np.array([0.0, 0.0, metres]))


def test_kittis_measure_is_the_error_over_the_length() -> None:
    true = [straight(one) for one in np.arange(0.0, 250.0)]
    found = [straight(0.98 * one) for one in np.arange(0.0, 250.0)]
    row = kitti_drift(found, true)
    assert row["drift_percent"] == pytest.approx(2.0)
    assert row["drift_deg_per_m"] == pytest.approx(0.0)
    turned = [SE3.exp([0, 0, 0, 0, np.deg2rad(0.01 * k), 0]) for k in range(250)]
    bent = [SE3(turn.rotation, pose.translation) for turn, pose in zip(turned, true, strict=True)]
    assert kitti_drift(bent, true)["drift_deg_per_m"] == pytest.approx(0.01)
    assert kitti_drift(true[:50], true[:50])["drift_percent"] is None


def test_poses_are_interpolated_over_short_gaps_only() -> None:
    stamps = np.array([0, 100, 1000], np.int64)
    path = Trajectory(stamps, [straight(0.0), straight(1.0), straight(5.0)])
    judge = InOneWorld({"a": path}, gap_ns=500)
    found = judge.node_from_live(("a", 0), ("a", 25))
    assert found is not None
    assert found.translation[2] == pytest.approx(0.25)
    assert judge.node_from_live(("a", 0), ("a", 1000)).distance_m == pytest.approx(5.0)
    for nowhere in (500, -1, 1001):
        assert judge.node_from_live(("a", 0), ("a", nowhere)) is None


def test_a_taught_loop_is_followed_the_shorter_way(tmp_path: Path) -> None:
    """Eight frames around a circle, the last one tied to the first."""
    run = tmp_path / "run_000000"
    (run / "images/left").mkdir(parents=True)
    (run / "timestamps_images.txt").write_text("".join(f"{k},{k + 1}\n" for k in range(8)))
    (tmp_path / "transform_camera_vehicle.txt").write_text(numbers(SE3.identity()))
    step = SE3.exp([1.0, 0.0, 0.0, 0.0, 0.0, np.pi / 4])
    lines = [
        ",".join(["0", str(k), "0", str((k + 1) % 8), *numbers(step.inverse()).split()])
        for k in range(8)
    ]
    (run / "transforms_temporal.txt").write_text("\n".join(lines))
    judge = TaughtPath(tmp_path, [run])
    ahead = judge.node_from_live((run.name, 1), (run.name, 2))
    np.testing.assert_allclose(ahead.matrix(), step.matrix(), atol=1e-6)
    around = judge.node_from_live((run.name, 8), (run.name, 1))
    np.testing.assert_allclose(around.matrix(), step.matrix(), atol=1e-6)
    back = judge.node_from_live((run.name, 1), (run.name, 8))
    np.testing.assert_allclose(back.matrix(), step.inverse().matrix(), atol=1e-6)
    assert judge.node_from_live((run.name, 1), (run.name, 99)) is None


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no public set 'nclt'; there are utias"):
        study_of("nclt", tmp_path, tmp_path / "out", "brief")
    with pytest.raises(SequenceError, match="0 drives of Oxford RobotCar"):
        study_of("robotcar", tmp_path, tmp_path / "out", "brief").run()
    for place in ("a", "b"):
        (tmp_path / place / "2014-05-14-13-53-47" / "stereo" / "left").mkdir(parents=True)
    with pytest.raises(SequenceError, match="drives of one name; leave one there"):
        study_of("robotcar", tmp_path, tmp_path / "out", "brief").run()
