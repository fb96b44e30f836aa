"""The benchmark runs, reports in the agreed shape, both sides solve the same problem; charts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from engram.errors import ConfigError
from engram.frontend.frontend import Frontend
from engram.odometry.odometry import Odometry
from engram.places.recognisers import FabMap
from engram.ranking.policies import policy_named
from engram_lab.bench import runner
from engram_lab.bench.data import BenchData, load_bench_data, scale_and_crop, synthetic_drive
from engram_lab.bench.maps import DenseTable, PlainFormula, made_up_vocabulary
from engram_lab.bench.runner import run_bench
from engram_lab.bench.stage import BenchReport, Machine, Side, StageResult, load_plain_pipeline
from engram_lab.bench.stages import STAGES, prepare_attempt, prepare_frontend_odometry
from engram_lab.bench.synthetic import SyntheticPlace
from engram_lab.charts import COLOURS, Line, Panel, draw_curves

STEP_M = 0.8


@pytest.fixture(scope="module")
def drive() -> BenchData:
    return BenchData("synthetic street", synthetic_drive(frames=6, step_m=STEP_M))


@pytest.fixture(scope="module")
def plain():
    module, why_not = load_plain_pipeline()
    if module is None:
        pytest.skip(why_not)
    return module


def test_odometry_on_the_synthetic_drive_is_true(drive: BenchData) -> None:
    frontend, odometry = Frontend(), Odometry()
    steps = [odometry.step(frontend.extract(pair)) for pair in drive.small]
    for step in steps[1:]:
        assert step.prev_from_curr is not None
        # 1 % of the step: a few hundred landmarks at 0.5 px between 2 and 70 m.
        np.testing.assert_allclose(
            step.prev_from_curr.translation, [0, 0, STEP_M], atol=0.02 * STEP_M
        )
        assert step.prev_from_curr.angle_rad < 1e-3


def test_the_plain_pipeline_is_an_honest_yardstick(drive: BenchData, plain) -> None:
    camera = drive.full[0].camera
    names = ("fx", "fy", "cx", "cy", "baseline_m", "width", "height")
    plain_camera = plain.Camera(*(getattr(camera, name) for name in names))
    frontend, odometry = plain.FrontEnd(plain_camera, 1000), plain.Odometry(plain_camera)
    poses = [odometry.step(frontend.extract(pair.left, pair.right)) for pair in drive.full]
    assert poses[0] is None
    for pose in poses[1:]:
        expected = np.eye(4)
        expected[2, 3] = -STEP_M  # live_from_reference: what lies ahead comes nearer
        np.testing.assert_allclose(pose.live_from_reference, expected, atol=0.02 * STEP_M)
        assert len(pose.inliers) > 100


@pytest.mark.parametrize("prepare", [prepare_frontend_odometry, prepare_attempt])
def test_both_sides_get_as_many_features(prepare, drive: BenchData, plain) -> None:
    prepared = prepare(drive, plain, size="512")
    for i in range(4):
        ours, reference = prepared.ours(i), prepared.reference(i)
    assert ours["inliers"] > 50
    assert reference["inliers"] > 30
    if "features" in reference:
        assert reference["features"] == pytest.approx(ours["landmarks"], rel=0.1)


def test_both_sides_of_the_window_stage_solve_a_problem_of_one_size(
    drive: BenchData, plain
) -> None:
    prepared = STAGES["window_ba_512"](drive, plain)
    assert prepared.ours(0) == prepared.reference(0)


@pytest.mark.parametrize("stage", ["rank_path_150", "rank_recall_150"])
def test_ranking_stages_are_of_the_size_they_say(stage: str, drive: BenchData) -> None:
    prepared = STAGES[stage](drive, None)
    assert prepared.ours(0) == {"paths": 150, "candidates": 200, "observed": 1000}
    assert prepared.best_of == 10


def test_the_plain_formula_ranks_as_path_does() -> None:
    place = SyntheticPlace(150)
    formula, path = PlainFormula(place), policy_named("path")
    for _ in range(3):
        context = place.context(200, 300)
        scores = formula.scores(context)[path.rank(context)]
        # Single precision in the reference: sums of 300 logarithms of about -6.
        assert np.diff(scores).max() < 0.01
        assert np.ptp(scores) > 1


def test_the_dense_table_finds_the_same_places() -> None:
    rng = np.random.default_rng(0)
    vocabulary = made_up_vocabulary(rng)
    recogniser, looks = FabMap(vocabulary), list(vocabulary.samples)
    table = DenseTable(vocabulary, recogniser.config, len(looks))
    for words in looks:
        recogniser.add(words)
        table.add(words)
    for words in looks[:5]:
        query = words[::2].copy()
        found = recogniser.recognise(query, 10)
        # float32 may swap what lies within its rounding, about 0.01 nats in sums of thousands.
        assert len(set(found.places) & set(table.best(query, 10))) >= 9
        assert found.places[0] in table.best(query, 2)


def test_training_is_timed_on_what_it_says(drive: BenchData, plain) -> None:
    prepared = STAGES["vocabulary_train"](drive, plain)
    assert prepared.ours(0) == {"words": 1000, "descriptors": 50_000}


def test_report_has_the_agreed_shape(drive: BenchData) -> None:
    seen = []
    report = run_bench(
        ["attempt_512"], repeats=3, progress=lambda *call: seen.append(call), data=drive
    )
    plain_values = json.loads(json.dumps(report.to_dict()))
    assert list(plain_values["stages"]) == ["attempt_512"]
    stage = plain_values["stages"]["attempt_512"]
    assert {"ms", "p99_ms", "reference_ms", "ratio"} <= stage.keys()
    assert 0 < stage["ms"] <= stage["p99_ms"]
    if stage["reference_ms"] is not None:
        assert stage["ratio"] == pytest.approx(stage["reference_ms"] / stage["ms"])
    assert plain_values["machine"]["data"] == "synthetic street"
    assert seen == [("attempt_512", 0, 1)]


def test_without_the_plain_pipeline_the_report_says_why(drive: BenchData, monkeypatch) -> None:
    monkeypatch.setattr(runner, "load_plain_pipeline", lambda: (None, "no reference: not here"))
    stage = run_bench(["attempt_512"], repeats=2, data=drive).to_dict()["stages"]["attempt_512"]
    assert stage["reference_ms"] is None
    assert stage["ratio"] is None
    assert stage["note"] == "no reference: not here"


def test_ratio_is_reference_over_ours() -> None:
    machine = Machine("cpu", "v4", 1, "3", "2", "5", None, "data")
    stage = StageResult("a", 5, Side(2.0, 3.0, {"inliers": 70.0}), Side(8.0, 9.0))
    report = BenchReport(machine, (stage,))
    assert report.to_dict()["stages"]["a"]["ratio"] == 4.0
    assert report.table().row_count == 1
    assert report.to_dict()["stages"]["a"]["in_attempts"] is None


def test_times_are_given_in_attempts_of_the_same_run() -> None:
    machine = Machine("cpu", "v4", 1, "3", "2", "5", None, "data")
    attempt = StageResult("attempt_512", 5, Side(0.5, 0.6), None)
    pair = StageResult("render_pair_512", 5, Side(40.0, 50.0), None)
    stages = BenchReport(machine, (attempt, pair)).to_dict()["stages"]
    assert stages["render_pair_512"]["in_attempts"] == 80.0


def test_unknown_stages_are_refused(drive: BenchData) -> None:
    with pytest.raises(ConfigError, match="unknown stage frontend; there are: frontend_odometry"):
        run_bench(["frontend"], data=drive)


def test_the_small_pairs_see_the_same_points(drive: BenchData) -> None:
    pair = drive.full[0]
    small = scale_and_crop(pair)
    assert small.left.shape == (384, 512)
    full = Frontend().extract(pair).landmarks.points_in_cam
    cropped = Frontend().extract(small).landmarks.points_in_cam
    # The walls stand at x = ±7 m and the ground at y = 1.6 m for both.
    for points in (full, cropped):
        near = points[points[:, 2] < 20]
        on_wall = np.abs(np.abs(near[:, 0]) - 7) < 0.3
        on_ground = np.abs(near[:, 1] - 1.6) < 0.1
        assert (on_wall | on_ground).mean() > 0.95


def test_without_real_images_the_drive_is_synthetic(monkeypatch) -> None:
    monkeypatch.delenv("ENGRAM_DATA", raising=False)
    data = load_bench_data()
    assert data.name == "synthetic street"
    assert len(data.full) == 24


@pytest.mark.long
def test_a_checkout_beside_itself_is_as_fast() -> None:
    from engram_lab.bench.against import HERE, compare

    (found,) = compare(HERE, ["rank_recall_150"], blocks=2, runs=10)
    assert found.ours_ms > 0
    assert found.theirs_ms > 0
    assert found.low <= found.ratio <= found.high
    with pytest.raises(ConfigError, match="does its checkout have this stage"):
        list(compare(HERE, ["no_such_stage"], blocks=2, runs=1))


def legend_of(
    monkeypatch: pytest.MonkeyPatch, labels: list[str], looks: dict[str, tuple[str, str]]
) -> dict[str, tuple[str, str]]:
    from matplotlib import pyplot

    shown: dict[str, tuple[str, str]] = {}

    def keep(figure, path: Path) -> None:
        [legend] = figure.legends
        for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=True):
            shown[text.get_text()] = (handle.get_color(), handle.get_linestyle())
        pyplot.close(figure)

    monkeypatch.setattr("engram_lab.charts.save", keep)
    line = np.arange(2.0)
    panel = Panel("", "", "", [Line(label, line, line) for label in labels])
    draw_curves([panel], Path("unused.png"), "", looks)
    return shown


def test_labels_without_a_look_take_what_the_picture_has_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second, third, fourth = ((one, "-") for one in COLOURS[:4])
    looks = {"a": second, "b": first, "absent": third}
    shown = legend_of(monkeypatch, ["new", "b", "a", "newer"], looks)
    assert shown == {"a": second, "b": first, "new": third, "newer": fourth}


def test_many_labels_get_other_line_styles_and_begin_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shown = legend_of(monkeypatch, [f"{k:02d}" for k in range(40)], {})
    assert shown["10"] == (COLOURS[10], "-")
    assert shown["11"] == (COLOURS[0], "--")
    assert shown["33"] == (COLOURS[0], "-")


def test_a_logarithmic_panel_without_anything_above_its_least_value_is_drawn(
    tmp_path: Path, recwarn: pytest.WarningsRecorder
) -> None:
    zeros = Line("nothing missed", np.arange(3.0), np.zeros(3))
    some = Line("something missed", np.arange(3.0), np.array([100.0, 1.0, 0.0]))
    for lines in ([zeros], [zeros, some]):
        draw_curves([Panel("", "", "", lines, least_y=0.01)], tmp_path / "a.png", "")
    draw_curves([Panel("", "", "", [zeros])], tmp_path / "a.png", "")
    assert [str(one.message) for one in recwarn.list] == []
