"""Guided matching by brute force, in plain NumPy: the method of kernels/matching.hpp."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import Frame
from engram.frontend.matching import MatcherConfig
from engram.geometry.se3 import SE3


def windows(
    reference: Frame, live: Frame, reference_from_live: SE3, covariance: NDArray, m: MatcherConfig
) -> tuple[NDArray, NDArray, NDArray]:
    """Where landmarks should be seen (N, 3), how far from there to look (N, 3), whether to."""
    marks, camera = reference.landmarks, live.camera
    rotation = reference_from_live.rotation.T
    points = marks.points_in_cam.astype(float)
    ray = points @ rotation.T
    seen = ray - rotation @ reference_from_live.translation
    front = seen[:, 2] > 0.1
    z = np.where(front, seen[:, 2], 1.0)
    along_u, along_v, d = camera.fx / z, camera.fy / z, camera.fx / z * camera.baseline_m
    stereo = np.column_stack(
        [along_u * seen[:, 0] + camera.cx, along_v * seen[:, 1] + camera.cy, d]
    )
    zero = np.zeros_like(z)
    gradients = np.stack(
        [
            np.column_stack([along_u, zero, -along_u * seen[:, 0] / z]),
            np.column_stack([zero, along_v, -along_v * seen[:, 1] / z]),
            np.column_stack([zero, zero, -d / z]),
        ],
        axis=1,
    )
    moving = -gradients @ rotation
    by_pose = np.concatenate([moving, np.cross(points[:, None], moving)], axis=2)
    by_depth = np.einsum("nki,ni->nk", gradients, ray)
    pixel = (m.pixel_sigma_px * (m.octave_scale ** marks.octaves.astype(float) + 1)) ** 2
    depth = (marks.disparity_sigma_px.astype(float) ** 2 + m.offset_sigma_px**2) / (
        marks.disparity_px.astype(float) ** 2
    )
    variance = (
        pixel[:, None]
        + depth[:, None] * by_depth**2
        + np.einsum("nki,ij,nkj->nk", by_pose, covariance, by_pose)
    )
    radius = np.minimum(m.gate_sigmas * np.sqrt(np.maximum(variance, 0)), m.max_radius_px)
    return stereo, radius, front


def match_near(
    reference: Frame, live: Frame, reference_from_live: SE3, covariance: NDArray, m: MatcherConfig
) -> list[tuple[int, int]]:
    """Pairs of rows that look alike near where the prediction has them."""
    stereo, radius, front = windows(reference, live, reference_from_live, covariance, m)
    there, own = live.landmarks, reference.landmarks
    measured = np.column_stack([there.pixels, there.disparity_px])
    reach = (m.gate_sigmas * there.disparity_sigma_px.astype(float)).astype(np.float32)
    pairs: list[tuple[int, int]] = []
    nearest = np.full(len(there), 10**6)
    nearest_row = np.full(len(there), -1)
    margin = m.max_radius_px
    right, bottom = there.pixels.max(axis=0, initial=0)
    for row in range(len(own)):
        u, v = stereo[row, :2]
        inside = -margin <= u <= right + margin and -margin <= v <= bottom + margin
        if not front[row] or not inside:
            continue
        allowed = np.tile(radius[row].astype(np.float32), (len(there), 1))
        allowed[:, 2] += reach
        away = np.abs(measured - stereo[row].astype(np.float32))
        near = np.flatnonzero((away <= allowed).all(axis=1))
        if not len(near):
            continue
        bits = np.unpackbits(own.descriptors[row] ^ there.descriptors[near], axis=1).sum(axis=1)
        closer = near[bits < nearest[near]]
        nearest[closer] = bits[bits < nearest[near]]
        nearest_row[closer] = row
        least = int(bits.min())
        best = int(near[np.argmin(bits)])
        rivals = near[bits * m.guided_ratio <= least]
        apart = np.abs(there.pixels[rivals] - there.pixels[best]) > m.same_corner_px
        if least <= m.max_guided_distance and not apart.any():
            pairs.append((row, best))
    return [(row, best) for row, best in pairs if nearest_row[best] == row]
