"""Errors against ground truth: evo's numbers, the formulas, and what cannot be compared."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import InputError
from engram.evaluation import aligned, apart, associated, evaluate
from engram.geometry.se3 import SE3
from engram.sequences.motion_files import Trajectory

SECOND = 1_000_000_000


def path(count: int, seed: int) -> Trajectory:
    """A robot at 10 Hz that turns as it likes, with a world frame of its own."""
    rng = np.random.default_rng(seed)
    pose, poses = SE3.exp(rng.normal(size=6)), []
    for _ in range(count):
        poses.append(pose)
        turn = rng.normal(scale=0.05, size=3)
        pose = pose @ SE3.exp(np.r_[rng.normal(scale=0.05, size=2), 0.6, turn])
    return Trajectory(np.arange(count, dtype=np.int64) * (SECOND // 10), poses)


def drifted(truth: Trajectory, seed: int) -> Trajectory:
    """The path as odometry has it, in another world frame, its stamps up to 4 ms off."""
    rng = np.random.default_rng(seed)
    pose, poses = SE3.exp(rng.normal(size=6)), []
    before = truth.world_from_cam[0]
    for true in truth.world_from_cam:
        noise = SE3.exp(rng.normal(scale=[0.02, 0.02, 0.02, 2e-3, 2e-3, 2e-3]))
        pose, before = pose @ (before.inverse() @ true) @ noise, true
        poses.append(pose)
    jitter_ns = rng.integers(-4_000_000, 4_000_000, len(truth))
    return Trajectory(truth.stamps_ns + jitter_ns, poses)


def part(one: Trajectory, every: int) -> Trajectory:
    return Trajectory(one.stamps_ns[::every], one.world_from_cam[::every])


# Of evo 1.38.1 for `compared(seed)`: rmse, median and maximum of APE (m; rmse in degrees), of RPE
# from pose to pose and over 10 m (`--pairs_from_reference`).
EVO = {
    0: [
        0.232868428, 0.205042747, 0.424738918, 1.292276062,
        0.034597981, 0.030661638, 0.071167417, 0.196842973,
        0.158375102, 0.149615185, 0.262349621, 0.658450815,
    ],
    1: [
        0.235771226, 0.234168660, 0.400592406, 1.011305238,
        0.051417502, 0.045977992, 0.098791593, 0.288878286,
        0.248047458, 0.226429329, 0.444299903, 0.900032506,
    ],
    2: [
        0.381548253, 0.397141639, 0.696452702, 1.362330420,
        0.058658134, 0.053229080, 0.113701162, 0.366290551,
        0.207408416, 0.187485653, 0.336432776, 1.070041355,
    ],
}  # fmt: skip


def compared(seed: int) -> tuple[Trajectory, Trajectory]:
    """An estimate and its truth; of two of three, one has fewer poses."""
    truth = path(240, seed)
    estimate = drifted(truth, seed + 100)
    return (estimate, truth) if seed % 3 == 0 else (
        (part(estimate, 2), truth) if seed % 3 == 1 else (estimate, part(truth, 3))
    )  # fmt: skip


def numbers(estimate: Trajectory, truth: Trajectory) -> list[float]:
    """What `EVO` has, by Engram."""
    found = evaluate(estimate, truth)
    rows = [(found.offset_m, found.turn_rad)]
    rows += [(one.offset_m, one.turn_rad) for one in found.relative if one.over_m in (None, 10.0)]
    return [
        value
        for offset, turn in rows
        for value in (offset.rmse, offset.median, offset.max, float(np.rad2deg(turn.rmse)))
    ]


def evos(estimate: Trajectory, truth: Trajectory) -> list[float]:
    """What `EVO` has, by evo."""
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D

    def theirs(one: Trajectory) -> PoseTrajectory3D:
        poses = [pose.matrix() for pose in one.world_from_cam]
        return PoseTrajectory3D(poses_se3=poses, timestamps=one.stamps_ns / 1e9)

    true, found = sync.associate_trajectories(theirs(truth), theirs(estimate))
    found.align(true)
    relations = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg
    rows: list[float] = []
    for delta, unit in ((0.0, None), (1.0, metrics.Unit.frames), (10.0, metrics.Unit.meters)):
        offset, turn = (
            metrics.APE(one)
            if unit is None
            else metrics.RPE(one, delta, unit, pairs_from_reference=True)
            for one in relations
        )
        offset.process_data((true, found))
        turn.process_data((true, found))
        of = offset.get_all_statistics()
        rows += [of["rmse"], of["median"], of["max"], turn.get_all_statistics()["rmse"]]
    return rows


@pytest.mark.parametrize("seed", EVO)
def test_errors_are_those_of_evo(seed: int) -> None:
    np.testing.assert_allclose(numbers(*compared(seed)), EVO[seed], rtol=0, atol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_errors_are_those_of_the_installed_evo(seed: int) -> None:
    pytest.importorskip("evo")
    np.testing.assert_allclose(numbers(*compared(seed)), evos(*compared(seed)), rtol=0, atol=1e-6)


def test_the_numbers_of_the_other_program_are_of_errors_that_a_person_can_see() -> None:
    """A path that is 10 cm too long per 10 m: no rotation, and 1 % of relative error."""
    along = [SE3(np.eye(3), np.array([0.0, 0.0, z])) for z in np.arange(0.0, 40.5, 0.5)]
    stamps_ns = np.arange(len(along), dtype=np.int64) * SECOND
    longer = [SE3(one.rotation, 1.01 * one.translation) for one in along]
    found = evaluate(Trajectory(stamps_ns, longer), Trajectory(stamps_ns, along))
    assert found.compared == found.poses == len(along)
    assert found.driven_m == pytest.approx(40.0)
    assert found.turn_rad.max == pytest.approx(0.0, abs=1e-9)
    # The alignment puts the middle of the two paths together: the ends are 20 cm off.
    assert found.offset_m.max == pytest.approx(0.2)
    (each, ten) = found.relative
    assert (each.pairs, ten.over_m, ten.pairs) == (80, 10.0, 4)
    assert each.offset_m.mean == pytest.approx(0.005)
    assert ten.offset_m.min == pytest.approx(0.1)
    assert "80 m" not in found.text()


@given(st.integers(0, 2**32 - 1), st.integers(3, 40))
def test_a_path_in_another_world_frame_has_no_error(seed: int, count: int) -> None:
    truth = path(count, seed)
    other = SE3.exp(np.random.default_rng(seed).normal(size=6))
    moved = Trajectory(truth.stamps_ns, [other @ one for one in truth.world_from_cam])
    found = evaluate(moved, truth)
    assert found.offset_m.max < 1e-9
    assert all(one.offset_m.max < 1e-9 for one in found.relative)


@given(st.integers(0, 2**32 - 1))
def test_the_alignment_is_the_best_rigid_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, targets = rng.normal(size=(2, 12, 3))
    best = aligned(points, targets)
    assert np.linalg.det(best.rotation) == pytest.approx(1.0)
    least = ((best @ points - targets) ** 2).sum()
    for _ in range(20):
        nearby = SE3.exp(rng.normal(scale=0.05, size=6)) @ best
        assert ((nearby @ points - targets) ** 2).sum() >= least


def test_poses_are_compared_at_the_nearest_stamps_up_to_ten_milliseconds() -> None:
    truth = path(10, 1)
    late = Trajectory(truth.stamps_ns + 10_000_000, truth.world_from_cam)
    assert len(associated(late, truth)[0]) == 10
    later = Trajectory(truth.stamps_ns + 10_000_001, truth.world_from_cam)
    with pytest.raises(InputError, match=r"0 of 10 poses .* within 10 ms, at least 3"):
        evaluate(later, truth)


def test_pairs_over_a_distance_do_not_overlap() -> None:
    assert apart(np.full(10, 1.0), 3.0) == [(0, 3), (3, 6), (6, 9)]
    assert apart(np.full(10, 1.0), 11.0) == []
