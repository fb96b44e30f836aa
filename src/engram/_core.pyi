"""The C++ core: arrays in, arrays out. Sorted by subject.

Functions of many rows release the GIL, `verified_columns` excepted, which reads Python's objects.
Those of a single transform or covariance do not: to take it back costs more than they do.
"""

import builtins
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

isa: str

# --- extraction: positions are (N, 2) int16 x, y, at least 17 px inside the image

def detect_corners(
    image: NDArray[np.uint8], threshold: int
) -> tuple[NDArray[np.int16], NDArray[np.uint8], NDArray[np.float32]]: ...
def equal_pixels(
    now: NDArray[np.uint8], before: NDArray[np.uint8], black: int, white: int
) -> tuple[int, int]: ...
def best_corners(
    image: NDArray[np.uint8], threshold: int, cell_px: int, most: int
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]: ...
def order_corners(
    positions: NDArray[np.int16], scores: NDArray[np.uint8], width: int, height: int, cell_px: int
) -> NDArray[np.int32]: ...
def smooth(image: NDArray[np.uint8]) -> NDArray[np.uint8]: ...
def halve(image: NDArray[np.uint8]) -> NDArray[np.uint8]: ...
def side_difference(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    max_disparity_px: int,
    mask: NDArray[np.bool_] | None = None,
) -> float: ...
def even_contrast(image: NDArray[np.uint8]) -> NDArray[np.uint8]: ...
def describe(smoothed: NDArray[np.uint8], positions: NDArray[np.int16]) -> NDArray[np.uint8]: ...
def measure_disparities(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    positions: NDArray[np.int16],
    max_disparity_px: int,
    min_disparity_px: float,
    uniqueness: float,
    max_residual: float,
    max_sigma_px: float,
    sigma_floor_px: float,
    sigma_scale: float,
    sides_differ: bool = False,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...
def quantise_landmarks(
    pixels: NDArray[np.float32],
    disparity_px: NDArray[np.float32],
    sigma_px: NDArray[np.float32],
    quantum_px: float,
    sigma_table: NDArray[np.float32],
    sigma_borders: NDArray[np.float32],
    camera: tuple[float, float, float, float, float],
) -> (
    tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]] | None
): ...
def thumbnail(image: NDArray[np.uint8], width_px: int) -> NDArray[np.uint8]: ...
def extract(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    landmarks: int,
    octaves: int,
    fast_threshold: int,
    cell_px: int,
    with_descriptors: bool,
    max_disparity_px: int,
    min_disparity_px: float,
    uniqueness: float,
    max_residual: float,
    max_sigma_px: float,
    sigma_floor_px: float,
    sigma_scale: float,
    second_threshold: int = 0,
    side_difference: float = 0,
    mask: NDArray[np.bool_] | None = None,
) -> tuple[
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.float32],
    NDArray[np.uint8],
    NDArray[np.uint8],
    int,
]: ...

# --- graph search

def pivoted_error(covariance: NDArray[np.float64]) -> NDArray[np.float64]: ...
def greatest_sigma(covariance: NDArray[np.float64]) -> float: ...
def pivoted_errors(
    covariances: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]: ...

NOT_LOADED: int

class GraphArrays:
    def __init__(
        self,
        first_half: NDArray[np.int32],
        next_half: NDArray[np.int32],
        target: NDArray[np.int32],
        a_from_b: NDArray[np.float64],
        errors: NDArray[np.float64],
        sessions: NDArray[np.int32],
        driven_m: NDArray[np.float64],
    ) -> None: ...

class CandidateLimits:
    radius_m: float
    margin_m: float
    view_gate_rad: float
    slack_sigmas: float
    slack_m: float
    vague_m: float
    detour_m: float
    own_session: int
    own_driven_m: float
    own_exclusion_m: float
    def __init__(self) -> None: ...

def graph_candidates(
    graph: GraphArrays,
    reference: int,
    reference_from_live: NDArray[np.float64],
    live_error: NDArray[np.float64],
    limits: CandidateLimits,
) -> (
    tuple[
        tuple[
            NDArray[np.int32],
            NDArray[np.float64],
            NDArray[np.float64],
            NDArray[np.float64],
            NDArray[np.float64],
            NDArray[np.float64],
            NDArray[np.float64],
            NDArray[np.float64],
            NDArray[np.float64],
        ],
        None,
    ]
    | tuple[None, NDArray[np.int32]]
): ...
def graph_chains(
    graph: GraphArrays,
    root: int,
    goals: NDArray[np.int32],
    edges: NDArray[np.int32] | None = None,
    closed: NDArray[np.int32] | None = None,
) -> (
    tuple[
        tuple[
            NDArray[np.int32],
            NDArray[np.int32],
            NDArray[np.int32],
            NDArray[np.float64],
            NDArray[np.float64],
        ],
        None,
    ]
    | tuple[None, NDArray[np.int32]]
): ...

# --- transforms

def chain(
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    covariance: NDArray[np.float64],
    next_rotation: NDArray[np.float64],
    next_translation: NDArray[np.float64],
    next_covariance: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]: ...
def transform_of(
    tangent: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...
def turn_of(rotation: NDArray[np.float64]) -> tuple[float, float]: ...
def tangent_of(
    rotation: NDArray[np.float64], translation: NDArray[np.float64], angle: float
) -> NDArray[np.float64]: ...
def orthonormalised(rotation: NDArray[np.float64]) -> NDArray[np.float64]: ...

# --- hamming

def hamming_matrix(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.uint16]: ...

# --- kept

def kept_rows(
    before: Features, now: Features, most_bits: int, most_disparity_px: float
) -> NDArray[np.int32]: ...

# --- matching

class MatchSettings:
    max_distance: int
    max_guided_distance: int
    ratio: float
    guided_ratio: float
    same_corner_px: float
    octave_scale: float
    patch_ratio: float
    pixel_sigma_px: float
    disparity_sigma_px: float
    offset_sigma_px: float
    offset_drift_px: float
    gate_sigmas: float
    max_radius_px: float
    chi2: float
    independent_landmarks: float
    few_inliers: float
    displaced_m: float
    offset_doubt: float
    calibration_share: float
    calibration_m: float
    calibration_rad: float
    min_consensus: int
    max_samples: int
    max_hypotheses: int
    min_followers: int
    glance_share: int
    glance_samples: int
    glance_consensus: int
    glance_inliers: int
    confidence: float
    max_view_angle_cosine: float
    second_pass: bool
    same_camera: bool
    def __init__(self) -> None: ...

class PatchNetwork:
    def __init__(
        self,
        first: NDArray[np.int8],
        second: NDArray[np.int8],
        third: NDArray[np.int8],
        linear: NDArray[np.int8],
        first_scaling: NDArray[np.int32],
        second_scaling: NDArray[np.int32],
        third_scaling: NDArray[np.int32],
        thresholds: NDArray[np.int32],
        shifts: NDArray[np.int32],
    ) -> None: ...
    def describe(
        self, image: NDArray[np.uint8], pixels: NDArray[np.float32], octaves: NDArray[np.uint8]
    ) -> NDArray[np.uint8]: ...

class Features:
    def __init__(
        self,
        pixels: NDArray[np.float32],
        disparity_px: NDArray[np.float32],
        disparity_sigma_px: NDArray[np.float32],
        points_in_cam: NDArray[np.float32],
        descriptors: NDArray[np.uint8],
        octaves: NDArray[np.uint8],
        camera: Sequence[float],
    ) -> None: ...

PoseAndInliers = tuple[
    NDArray[np.float64], NDArray[np.float64], NDArray[np.int32], NDArray[np.int32]
]

def match_rows(
    reference: Features,
    live: Features,
    settings: MatchSettings,
    predicted: NDArray[np.float64] | None = None,
    covariance: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.int32], NDArray[np.int32]]: ...
def estimate_pose(
    reference: Features,
    live: Features,
    reference_rows: NDArray[np.int32],
    live_rows: NDArray[np.int32],
    settings: MatchSettings,
    seed: int,
) -> PoseAndInliers | None: ...

class WorkThreads:
    def __init__(self, others: int) -> None: ...

AttemptArguments: TypeAlias = tuple[
    Features, MatchSettings, int, NDArray[np.float64] | None, NDArray[np.float64] | None
]

def attempt(
    live: Features, attempts: Sequence[AttemptArguments], threads: WorkThreads | None = None
) -> list[PoseAndInliers | None]: ...

# --- ordering

def order_rows(uuid_words: NDArray[np.uint64], *keys: NDArray[np.float64]) -> NDArray[np.int64]: ...
def success_rates(
    rates: NDArray[np.float64],
    bin_m: float,
    along_m: NDArray[np.float64],
    across_m: NDArray[np.float64],
) -> NDArray[np.float64]: ...

# --- recall

class RecallRun:
    def __init__(
        self,
        driven_m: float,
        at_m: NDArray[np.float64],
        nodes: NDArray[np.int32],
        sessions: NDArray[np.int32],
        distance_m: NDArray[np.float64],
        rates: NDArray[np.float64],
        accepted: NDArray[np.bool_],
        inliers: NDArray[np.int64],
    ) -> None: ...

class RecallCandidates:
    def __init__(
        self,
        nodes: NDArray[np.int32],
        sessions: NDArray[np.int32],
        costs: NDArray[np.float64],
        prior: NDArray[np.float64],
    ) -> None: ...

class RecallConstants:
    per_m: float
    level: float
    memory_m: float
    prior_weight: float
    regret: float
    tally: float
    tally_memory_m: float
    untried_rate: float
    untried_attempts: float
    needed: int
    attempts: int
    picks: int
    shortlist: int
    def __init__(self) -> None: ...

def recall_order(
    run: RecallRun, candidates: RecallCandidates, constants: RecallConstants
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]: ...

# --- odometry

class OdometrySettings:
    match: MatchSettings
    window_frames: int
    window_landmarks: int
    window_iterations: int
    window_offset_sigma_px: float
    window_pixel_sigma_px: float
    window_disparity_sigma_px: float
    min_inliers: int
    unexpected_inliers: int
    plausible_inliers: int
    few_inliers: float
    usual_share: float
    acceleration_m_s2: float
    angular_acceleration_rad_s2: float
    max_prediction_s: float
    steady_m: float
    steady_rad: float
    steady_share: float
    braking_m_s2: float
    braking_share: float
    disbelief_s: float
    keyframe_flow_px: float
    keyframe_share: float

class Odometry:
    @property
    def tracks(self) -> int: ...
    @property
    def offset_px(self) -> float: ...
    def __init__(self, settings: OdometrySettings) -> None: ...
    def step(
        self,
        live: Features,
        stamp_ns: int,
        expected: NDArray[np.float64] | None = None,
        covariance: NDArray[np.float64] | None = None,
    ) -> tuple[
        int,
        NDArray[np.float64] | None,
        NDArray[np.float64] | None,
        NDArray[np.float64] | None,
        int,
    ]: ...

# --- rows

def verified_columns(
    rows: list[tuple[Any, ...]], kinds: list[str]
) -> tuple[list[Any] | None, int, int]: ...

# --- path memory

class PathBits:
    def __init__(self, bits: NDArray[np.uint64], count: int) -> None: ...

class PathEvidence:
    def __init__(
        self,
        observed: NDArray[np.int32],
        outcomes: NDArray[np.bool_],
        reference: int,
        excluded: int,
        alpha: float,
        gamma: float,
    ) -> None: ...

class PathCandidates:
    def __init__(
        self,
        nodes: NDArray[np.int32],
        along_m: NDArray[np.float64],
        across_m: NDArray[np.float64],
        distance_m: NDArray[np.float64],
        uuid_words: NDArray[np.uint64],
    ) -> None: ...

class ObservedPaths:
    def __init__(self) -> None: ...
    def add(self, node: int, path: int) -> None: ...

def co_occurrence(
    paths: PathBits, a: NDArray[np.int32], b: NDArray[np.int32], excluded: int = -1
) -> NDArray[np.int32]: ...
def path_scores(
    known: ObservedPaths, paths: PathBits, candidates: NDArray[np.int32], evidence: PathEvidence
) -> NDArray[np.float64]: ...
def path_order(
    known: ObservedPaths,
    paths: PathBits,
    candidates: PathCandidates,
    evidence: PathEvidence,
    basin_rates: NDArray[np.float64],
    bin_m: float,
    level: float,
) -> NDArray[np.int64]: ...

# --- places: vocabularies of binary words, and which places show them

class WordTree:
    def __init__(self, centres: NDArray[np.uint8], bounds: NDArray[np.int32]) -> None: ...
    def quantise(self, descriptors: NDArray[np.uint8], beam: int) -> NDArray[np.int32]: ...

def k_majority(
    descriptors: NDArray[np.uint8], k: int, iterations: int, seed: int
) -> tuple[NDArray[np.uint64], NDArray[np.int32]]: ...
def best_scores(scores: NDArray[np.float64], most: int) -> NDArray[np.int64]: ...

class PlaceIndex:
    def __init__(self, words: int) -> None: ...
    def __len__(self) -> int: ...
    @property
    def bytes(self) -> int: ...
    def add(self, words: NDArray[np.int32]) -> int: ...
    def add_weights(
        self, words: NDArray[np.int32], weights: NDArray[np.float64], sums: NDArray[np.float64]
    ) -> None: ...
    @property
    def sealed(self) -> int: ...
    def block(self, number: int) -> builtins.bytes: ...

PLACES_PER_BLOCK: int

def add_block_weights(
    body: bytes,
    words_in_all: int,
    words: NDArray[np.int32],
    weights: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None: ...

# --- window_ba

def adjust_window(
    camera: Sequence[float],
    world_from_cam: NDArray[np.float64],
    frame: NDArray[np.int32],
    track: NDArray[np.int32],
    stereo: NDArray[np.float32],
    pixel_sigma_px: NDArray[np.float32],
    disparity_sigma_px: NDArray[np.float32],
    fixed: int,
    iterations: int,
    chi2: float,
    offset_px: float,
    offset_sigma_px: float,
) -> (
    tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float, float, float] | None
): ...
