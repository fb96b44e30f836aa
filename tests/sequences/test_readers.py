"""The contract of every reader, and how readers of images meet faults, on small drives."""

import shutil
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from engram.errors import CalibrationError, ConfigError, InputError, SequenceError
from engram.frontend.frame import StereoPair
from engram.graph.model import Clock
from engram.sequences.images import read_image
from engram.sequences.layouts import ImageSequence, find_folder
from engram.sequences.opening import SEQUENCES, open_drive
from engram.sequences.sequence import FrameRange, OpenOptions, first_pair_hash, session_of
from engram.testing.contracts import WriteDrive, check_reader, unmet

from .synthetic import (
    HEIGHT,
    LAYOUTS,
    PAIRS,
    PERIOD_NS,
    WIDTH,
    ImageLayout,
    logged,
    only_engram_errors,
    picture,
    write_image,
    write_log,
)
from .test_public_sets import write_fourseasons, write_robotcar, write_tumvi, write_utias


def in_layout(layout: ImageLayout) -> WriteDrive:
    def write(folder: Path, pairs: Sequence[StereoPair]) -> Path:
        return layout.write(
            folder, lambda index, side: (pairs[index].left, pairs[index].right)[side]
        )

    return write


def write_bag(folder: Path, pairs: Sequence[StereoPair]) -> Path:
    bags = pytest.importorskip(
        "tests.sequences.bag_maker", reason="the extra `bags` is not installed"
    )
    with bags.bag(folder / "drive", "mcap") as maker:
        for pair in pairs:
            infos = bags.rectified_infos(pair.camera)
            for topic, image, info in zip(
                (bags.LEFT, bags.RIGHT), (pair.left, pair.right), infos, strict=True
            ):
                maker.image(topic, pair.stamp_ns, image)
                maker.info(topic.replace("image_raw", "camera_info"), pair.stamp_ns, info)
    return bags.made(folder / "drive", "mcap")


def write_framelog(folder: Path, pairs: Sequence[StereoPair]) -> Path:
    frames = [logged(index) for index in range(len(pairs))]
    return write_log(folder / "monday.framelog", frames)


# Format, and what writes a small drive of it.
WRITERS: list[tuple[str, WriteDrive]] = [
    *((layout.format, in_layout(layout)) for layout in LAYOUTS.values()),
    ("tum-vi", write_tumvi),
    ("robotcar", write_robotcar),
    ("utias", write_utias),
    ("4seasons", write_fourseasons),
    ("bag", write_bag),
    ("framelog", write_framelog),
]
# Their calibration is not one that Engram could write.
OWN_CAMERAS = {"tum-vi", "robotcar", "utias"}


@pytest.mark.parametrize(("name", "write"), WRITERS)
def test_every_reader_meets_the_contract(name: str, write: WriteDrive) -> None:
    writes_camera = name not in OWN_CAMERAS
    checks = check_reader(name, SEQUENCES[name], write, writes_camera=writes_camera)
    assert unmet(checks) == []


@pytest.mark.parametrize("name", list(SEQUENCES))
def test_every_reader_has_a_drive_for_its_contract(name: str) -> None:
    assert name in {written for written, _ in WRITERS}, (
        f"no test reads a drive of the format {name!r}: add what writes a small one to LAYOUTS of "
        "tests/sequences/synthetic.py if it consists of image files, else to WRITERS here"
    )


@dataclass(frozen=True)
class Drive:
    layout: ImageLayout
    path: Path

    def image(self, index: int, side: int) -> Path:
        return self.layout.image(self.path, index, side)

    @property
    def calibration(self) -> Path:
        return self.layout.calibration(self.path)

    def open(self, **options) -> ImageSequence:
        sequence = open_drive(self.path, **options)
        assert isinstance(sequence, ImageSequence)
        return sequence

    def read(self, **options) -> list:
        return list(self.open(**options))

    def stamps_of(self, *indices: int) -> list[int]:
        return [self.layout.first_ns + index * PERIOD_NS for index in indices]

    def change_stamps(self, change: Callable[[list[str]], list[str]]) -> Path:
        if self.layout.stamps is None:
            pytest.skip("this layout keeps its stamps in the names")
        path = self.layout.stamps(self.path)
        lines = path.read_text().splitlines()
        head = self.layout.head
        path.write_text("\n".join([*lines[:head], *change(lines[head:])]) + "\n")
        return path


@pytest.fixture(params=list(LAYOUTS))
def drive(request: pytest.FixtureRequest, tmp_path: Path) -> Drive:
    layout = LAYOUTS[request.param]
    return Drive(layout, layout.write(tmp_path))


class TestGoodDrives:
    def test_pairs_come_in_order_with_their_stamps(self, drive: Drive) -> None:
        sequence = drive.open()
        pairs = list(sequence)
        assert len(sequence) == len(pairs) == PAIRS
        assert [pair.stamp_ns for pair in pairs] == drive.stamps_of(*range(PAIRS))
        assert sequence.stamps_ns.tolist() == [pair.stamp_ns for pair in pairs]
        assert sequence.skipped == 0

    def test_left_is_left_and_right_is_right(self, drive: Drive) -> None:
        sequence = drive.open()
        for index, pair in enumerate(sequence):
            for side, image in enumerate((pair.left, pair.right)):
                assert image.dtype == np.uint8
                assert image.flags.c_contiguous
                wanted = picture(index, side)
                if sequence.rectification is not None:  # pixel centres move by a few hundredths
                    assert np.corrcoef(image.ravel(), wanted.ravel())[0, 1] > 0.8
                else:
                    np.testing.assert_array_equal(image, wanted)
            assert pair.camera == sequence.camera

    def test_the_camera_is_that_of_the_calibration(self, drive: Drive) -> None:
        camera = drive.open().camera
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert camera.baseline_m == pytest.approx(0.1, abs=1e-9)
        # Rectification may zoom by a few percent to hide the border.
        assert camera.fx == pytest.approx(40.0, rel=0.05)

    def test_reading_twice_gives_the_same_session(self, drive: Drive) -> None:
        sessions = set()
        for _ in range(2):
            sequence = drive.open(robot="husky")
            first = next(iter(sequence))
            sessions.add(
                session_of(sequence.info, sequence.camera, first.stamp_ns, first_pair_hash(first))
            )
        assert len(sessions) == 1

    def test_another_first_frame_is_another_session(self, drive: Drive) -> None:
        ids = set()
        for frames in ("0:", "1:"):
            sequence = drive.open(frames=frames)
            first = next(iter(sequence))
            hashed = first_pair_hash(first)
            ids.add(session_of(sequence.info, sequence.camera, first.stamp_ns, hashed).id)
        assert len(ids) == 2

    @pytest.mark.parametrize(
        ("frames", "wanted"),
        [
            ("2:", (2, 3, 4, 5)),
            (":3", (0, 1, 2)),
            ("1:6:2", (1, 3, 5)),
            ("::4", (0, 4)),
            ("3", (3,)),
        ],
    )
    def test_frames_are_those_of_a_python_slice(self, drive: Drive, frames, wanted) -> None:
        assert [pair.stamp_ns for pair in drive.read(frames=frames)] == drive.stamps_of(*wanted)

    def test_frames_beyond_the_end_are_told(self, drive: Drive) -> None:
        with pytest.raises(SequenceError, match=f"none of its {PAIRS} pairs is chosen"):
            drive.open(frames="100:")

    def test_colour_images_become_grey_or_one_channel(self, drive: Drive) -> None:
        colour = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
        colour[:] = (200, 100, 50)  # blue, green, red
        for index in range(PAIRS):
            for side in range(2):
                write_image(drive.image(index, side), colour)
        centre = (HEIGHT // 2, WIDTH // 2)
        values = {
            channel: int(drive.open(channel=channel).read(0).left[centre])
            for channel in ("grey", "red", "green", "blue")
        }
        assert values["grey"] == round(0.299 * 50 + 0.587 * 100 + 0.114 * 200)
        assert (values["red"], values["green"], values["blue"]) == (50, 100, 200)

    def test_sixteen_bits_are_scaled_to_eight(self, drive: Drive) -> None:
        for side in range(2):
            write_image(drive.image(1, side), np.full((HEIGHT, WIDTH), 51400, dtype=np.uint16))
        assert drive.open().read(1).left[HEIGHT // 2, WIDTH // 2] == 200

    def test_hidden_files_and_notes_do_not_disturb(self, drive: Drive) -> None:
        folder = drive.image(0, 0).parent
        (folder / "notes.txt").write_text("sunny")
        (folder / ".hidden.png").write_bytes(b"")
        assert len(drive.read()) == PAIRS

    def test_a_start_time_moves_clocks_that_are_not_utc(self, drive: Drive) -> None:
        start = "2015-06-01T12:00:00+02:00"
        if drive.open().info.clock is Clock.UTC:
            with pytest.raises(ConfigError, match="UTC already"):
                drive.open(recorded_at=start)
            return
        pairs = drive.read(recorded_at=start, frames="1:3")
        noon_ns = 1_433_152_800 * 10**9
        assert [pair.stamp_ns for pair in pairs] == [noon_ns + PERIOD_NS, noon_ns + 2 * PERIOD_NS]

    def test_a_grey_drive_has_no_blue_channel(self, drive: Drive) -> None:
        with pytest.raises(ConfigError, match=r"'blue'.*grey"):
            drive.open(channel="blue", skip_bad=True).read(0)


def _cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def _empty(path: Path) -> None:
    path.write_bytes(b"")


def _no_image(path: Path) -> None:
    path.write_text("this is no image")


def _wrong_size(path: Path) -> None:
    write_image(path, np.zeros((HEIGHT + 1, WIDTH), dtype=np.uint8))


def _a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _gigapixel(path: Path) -> None:
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    chunk = b"IHDR" + header
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    )


def _floating_point(path: Path) -> None:
    ok, content = cv2.imencode(".tiff", np.zeros((HEIGHT, WIDTH), dtype=np.float32))
    assert ok
    path.write_bytes(content.tobytes())


IMAGE_FAULTS = {
    "cut short": (_cut_short, "not a readable image|cut short"),
    "empty": (_empty, "empty"),
    "no image": (_no_image, "not a readable image"),
    "wrong size": (_wrong_size, "48×33 px, the calibration says 48×32"),
    "a folder": (_a_folder, "cannot be read"),
    "a gigapixel": (_gigapixel, "60000×60000 px.*not decoded"),
    "floating point": (_floating_point, "float32"),
    "missing": (Path.unlink, "missing|no right image|no left image"),
}


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("fault", list(IMAGE_FAULTS))
class TestBadImages:
    def test_the_file_and_the_fact_are_named(self, drive: Drive, fault: str, side: int) -> None:
        spoil, fact = IMAGE_FAULTS[fault]
        path = drive.image(2, side)
        spoil(path)
        with pytest.raises(SequenceError, match=fact) as caught:
            drive.read()
        assert "--set drive.skip_bad=true" in str(caught.value)
        # Kitti names a missing image by its number and folder, which is what people look for.
        assert path.name in str(caught.value) or fault == "missing"

    def test_skip_bad_goes_on_and_counts(self, drive: Drive, fault: str, side: int) -> None:
        IMAGE_FAULTS[fault][0](drive.image(2, side))
        sequence = drive.open(skip_bad=True)
        for _ in range(2):  # a second pass does not count twice
            stamps = [pair.stamp_ns for pair in sequence]
            assert stamps == drive.stamps_of(0, 1, 3, 4, 5)
            assert sequence.skipped == len(sequence.skipped_reasons) == 1 or (
                # Without a list of stamps, the other image of the pair is left over by itself.
                drive.layout.stamps is None and fault == "missing"
            )

    def test_bad_frames_that_are_not_chosen_do_not_matter(self, drive, fault, side) -> None:
        IMAGE_FAULTS[fault][0](drive.image(2, side))
        if drive.layout.stamps is None and fault == "missing":
            pytest.skip("without a list of stamps nobody can tell that an image is missing")
        assert len(drive.read(frames="3:")) == PAIRS - 3


class TestBadLayouts:
    def test_an_extra_image_is_named(self, drive: Drive) -> None:
        extra = drive.layout.image(drive.path, PAIRS, 0)
        shutil.copy(drive.image(0, 0), extra)
        with pytest.raises(SequenceError, match=f"{extra.name}.*(extra|no right image)"):
            drive.open()
        assert len(drive.read(skip_bad=True)) == PAIRS

    def test_a_pair_of_extra_images_is_named(self, drive: Drive) -> None:
        if drive.layout.stamps is None:
            pytest.skip("names are stamps: this is just one more pair")
        for side in range(2):
            shutil.copy(drive.image(0, side), drive.layout.image(drive.path, PAIRS, side))
        with pytest.raises(SequenceError, match="extra"):
            drive.open()

    @pytest.mark.parametrize("side", [0, 1])
    def test_an_empty_image_folder_is_named(self, drive: Drive, side: int) -> None:
        folder = drive.image(0, side).parent
        shutil.rmtree(folder)
        folder.mkdir()
        with pytest.raises(SequenceError, match="no images here") as caught:
            drive.open(skip_bad=True)
        assert str(folder) in str(caught.value)

    def test_a_missing_image_folder_is_named(self, drive: Drive) -> None:
        folder = drive.image(0, 1).parent
        shutil.rmtree(folder)
        with pytest.raises(SequenceError, match="folder is missing") as caught:
            drive.open(skip_bad=True)
        assert str(folder) in str(caught.value)

    def test_a_drive_without_any_good_pair_is_told(self, drive: Drive) -> None:
        if drive.layout.stamps is None:
            pytest.skip("other names, other pairs")
        for index in range(PAIRS):
            drive.image(index, index % 2).unlink(missing_ok=True)
        with pytest.raises(SequenceError):
            drive.open(skip_bad=True)

    def test_layouts_with_one_rig_know_no_other(self, drive: Drive) -> None:
        with pytest.raises(InputError, match=r"rig|image_02|image_2"):
            drive.open(rig="colour")


class TestBadStamps:
    def test_unsorted_stamps(self, drive: Drive) -> None:
        path = drive.change_stamps(lambda lines: [*lines[:2], lines[3], lines[2], *lines[4:]])
        assert len(drive.read()) == PAIRS - 1
        assert drive.open().stamps.early == 1
        assert path.name in drive.open().stamp_facts[0]
        assert drive.open().skipped == 0

    def test_repeated_stamps(self, drive: Drive) -> None:
        drive.change_stamps(lambda lines: [*lines[:3], lines[2], *lines[4:]])
        sequence = drive.open(skip_bad=True)  # a layout may name the image beside the stamp
        assert len(list(sequence)) == PAIRS - 1
        assert sequence.stamps.repeated == 1

    def test_too_many_stamps(self, drive: Drive) -> None:
        def add(lines: list[str]) -> list[str]:
            last = lines[-1]
            return [
                *lines,
                last.replace("5", "6") if "," in last else "6".join(last.rsplit("5", 1)),
            ]

        drive.change_stamps(add)
        with pytest.raises(SequenceError, match=r"missing|stamp"):
            drive.open()
        assert len(drive.read(skip_bad=True)) == PAIRS

    def test_too_few_stamps(self, drive: Drive) -> None:
        drive.change_stamps(lambda lines: lines[:-1])
        with pytest.raises(SequenceError, match="extra"):
            drive.open()
        assert len(drive.read(skip_bad=True)) == PAIRS - 1

    @pytest.mark.parametrize("text", ["noon", "nan", "1e400", "", "9" * 40, "٣", "1e99"])
    def test_what_is_no_stamp(self, drive: Drive, text: str) -> None:
        path = drive.change_stamps(lambda lines: [lines[0], f"{text},x", *lines[2:]])
        with pytest.raises(SequenceError, match=r"line [23] is") as caught:
            drive.open()
        assert path.name in str(caught.value)

    def test_no_stamps_at_all(self, drive: Drive) -> None:
        drive.change_stamps(lambda lines: [])
        with pytest.raises(SequenceError, match=r"no stamp|names no image"):
            drive.open()

    def test_a_missing_file_of_stamps(self, drive: Drive) -> None:
        path = drive.change_stamps(lambda lines: lines)
        path.unlink()
        with pytest.raises(SequenceError, match=path.name if path.name != "times.txt" else "times"):
            drive.open()


def _edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


class TestBadCalibrations:
    def test_missing(self, drive: Drive) -> None:
        drive.calibration.unlink()
        with pytest.raises(InputError, match=drive.calibration.name) as caught:
            drive.open()
        assert str(caught.value).count(drive.calibration.name) == 1

    @pytest.mark.parametrize("text", ["", "hello", "[[[[", "\0\0\0", "P0: x\nP1: y", "- 1\n- 2"])
    def test_something_else(self, drive: Drive, text: str) -> None:
        drive.calibration.write_text(text)
        with pytest.raises(CalibrationError, match=drive.calibration.name):
            drive.open()

    @pytest.mark.parametrize("value", ["nan", "inf", "-40", "0", "'forty'"])
    def test_an_impossible_focal_length(self, drive: Drive, value: str) -> None:
        path = drive.calibration
        old = {".txt": ": 40 0", ".yaml": "[40.0,", ".toml": "fx = 40.0"}[path.suffix]
        _edit(path, old, old.replace("40.0", value).replace("40", value))
        with pytest.raises(CalibrationError, match=path.name):
            drive.open()

    def test_left_and_right_swapped(self, drive: Drive) -> None:
        path = drive.calibration
        old, new = {
            ".txt": ("-4.0", "4.0"),
            ".yaml": ("0.0, 0.1,", "0.0, -0.1,"),
            ".toml": ("0.1", "-0.1"),
        }[path.suffix]
        _edit(path, old, new)
        with pytest.raises(CalibrationError, match=r"baseline|right camera is"):
            drive.open()

    def test_of_another_size(self, drive: Drive) -> None:
        path = drive.calibration
        if path.name == "calib.txt":
            pytest.skip("KITTI odometry's calibration names no size")
        if path.name == "sensor.yaml":
            _edit(drive.path / "mav0/cam0/sensor.yaml", "[48, 32]", "[64, 32]")
        old, new = {".txt": ("48 32", "64 32"), ".yaml": ("[48,", "[64,"), ".toml": ("48", "64")}[
            path.suffix
        ]
        _edit(path, old, new)
        with pytest.raises(SequenceError, match="48×32 px, the calibration says 64×32"):
            drive.read()


class TestRecognition:
    def test_the_layout_is_seen_from_the_path(self, drive: Drive) -> None:
        assert drive.open().info.format == drive.layout.format
        assert drive.open(format=drive.layout.format).info.format == drive.layout.format

    def test_a_map_where_a_drive_is_expected(self, tmp_path: Path) -> None:
        with pytest.raises(SequenceError, match="the map is given first"):
            open_drive(tmp_path / "town.engram")

    def test_a_path_that_does_not_exist(self, tmp_path: Path) -> None:
        with pytest.raises(SequenceError, match="there is no such"):
            open_drive(tmp_path / "nowhere")

    @pytest.mark.parametrize("kind", ["empty folder", "text file"])
    def test_a_path_that_is_no_drive_lists_what_is_known(self, tmp_path: Path, kind: str) -> None:
        path = tmp_path / "x"
        path.mkdir() if kind == "empty folder" else path.write_text("hello")
        with pytest.raises(SequenceError) as caught:
            open_drive(path)
        assert all(name in str(caught.value) for name in SEQUENCES)

    def test_a_path_that_is_two_things_is_not_guessed(self, tmp_path: Path) -> None:
        path = LAYOUTS["folder"].write(tmp_path)
        (path / "cam0").mkdir()
        with pytest.raises(SequenceError, match=r"euroc or folder.*--set drive\.format=NAME"):
            open_drive(path)
        assert len(list(open_drive(path, format="folder"))) == PAIRS

    @pytest.mark.parametrize(
        "options", [{"format": "mp4"}, {"rig": "left"}, {"channel": "infrared"}, {"frames": "a"}]
    )
    def test_unknown_names_are_refused(self, tmp_path: Path, options: dict) -> None:
        path = LAYOUTS["folder"].write(tmp_path)
        with pytest.raises(ConfigError):
            open_drive(path, **options)

    @pytest.mark.parametrize("name", ["kitti", "kitti-raw"])
    def test_a_missing_rig_points_to_the_other(self, tmp_path: Path, name: str) -> None:
        path = LAYOUTS[name].write(tmp_path)
        with pytest.raises(SequenceError, match="choose rig 'grey'"):
            open_drive(path, rig="colour")

    @pytest.mark.parametrize("folder", ["", "mav0"])
    def test_euroc_may_be_named_by_its_inner_folder(self, tmp_path: Path, folder: str) -> None:
        drive = open_drive(LAYOUTS["euroc"].write(tmp_path) / folder)
        assert (drive.info.name, drive.info.format, len(drive)) == ("V9_01", "euroc", PAIRS)

    def test_euroc_without_its_left_camera_is_known_and_the_file_named(self, tmp_path) -> None:
        path = LAYOUTS["euroc"].write(tmp_path)
        shutil.rmtree(path / "mav0" / "cam0")
        with pytest.raises(CalibrationError, match=r"cam0.*missing"):
            open_drive(path)

    def test_places_and_robots_come_from_the_caller_or_the_files(self, tmp_path: Path) -> None:
        path = LAYOUTS["folder"].write(tmp_path)
        file = path / "calibration.toml"
        file.write_text('robot = "husky"\nlongitude_deg = 8.4\n' + file.read_text())
        info = open_drive(path).info
        assert (info.robot, info.longitude_deg, info.zone) == ("husky", 8.4, None)
        info = open_drive(path, robot="jackal", longitude_deg=-1.26, zone="Europe/London").info
        assert (info.robot, info.longitude_deg, info.zone) == ("jackal", -1.26, "Europe/London")
        with pytest.raises(ConfigError, match="longitude"):
            open_drive(path, longitude_deg=200)
        with pytest.raises(ConfigError, match="time zone"):
            open_drive(path, zone="Mars/Olympus_Mons")

    def test_kitti_raw_takes_the_longitude_from_gps(self, tmp_path: Path) -> None:
        path = LAYOUTS["kitti-raw"].write(tmp_path)
        record = path / "oxts" / "data" / "0000000000.txt"
        record.parent.mkdir(parents=True)
        record.write_text("49.015003823272 8.4342971002335 116.43032836914 0.035752")
        assert open_drive(path).info.longitude_deg == 8.4342971002335


def test_pairs_by_stamp_bear_a_small_difference_only(tmp_path: Path) -> None:
    path = LAYOUTS["folder, named by stamp"].write(tmp_path)
    for index, file in enumerate(sorted((path / "right").iterdir())):
        file.rename(file.with_name(f"{int(file.stem) + (index - 1) * 1_000_000}.png"))
    assert len(list(open_drive(path))) == PAIRS
    with pytest.raises(SequenceError, match=r"no right image within 2\.5 ms \(the nearest is 3\.0"):
        open_drive(path, pair_tolerance_ns=2_500_000)
    assert len(list(open_drive(path, pair_tolerance_ns=2_500_000, skip_bad=True))) == 4


def test_raw_folders_are_rectified(tmp_path: Path) -> None:
    path = LAYOUTS["folder"].write(tmp_path)
    (path / "calibration.toml").write_text(
        """
        [raw]
        width = 48
        height = 32
        right_from_left = [1, 0, 0, -0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
        [raw.left]
        fx = 40.0
        fy = 40.0
        cx = 23.5
        cy = 15.5
        distortion = "radial-tangential"
        coefficients = [-0.2, 0.05, 0, 0]
        [raw.right]
        fx = 41.0
        fy = 41.0
        cx = 23.0
        cy = 15.5
        """
    )
    drive = open_drive(path)
    assert drive.rectification is not None
    assert drive.camera.rectification
    assert drive.camera.baseline_m == pytest.approx(0.1)
    assert drive.info.clock is Clock.UNKNOWN
    assert len(list(drive)) == PAIRS


def test_an_unknown_key_of_a_calibration_is_refused(tmp_path: Path) -> None:
    path = LAYOUTS["folder"].write(tmp_path)
    _edit(path / "calibration.toml", "baseline_m", "basline_m")
    with pytest.raises(CalibrationError, match=r"calibration\.toml.*rectified\.basline_m"):
        open_drive(path)


# Mangled files: nothing but our own errors, whatever the bytes.
mangling = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@pytest.mark.parametrize("name", list(LAYOUTS))
@mangling
@given(data=st.data())
def test_mangled_texts_raise_nothing_but_our_errors(tmp_path_factory, name, data) -> None:
    layout = LAYOUTS[name]
    drive = Drive(layout, layout.write(tmp_path_factory.mktemp("mangled")))
    files = [drive.calibration, *([layout.stamps(drive.path)] if layout.stamps else [])]
    path = data.draw(st.sampled_from(files))
    content = path.read_bytes()
    start = data.draw(st.integers(0, len(content)))
    end = data.draw(st.integers(start, min(len(content), start + 30)))
    filling = data.draw(
        st.one_of(
            st.binary(max_size=20),
            st.text(max_size=10).map(lambda text: text.encode("utf-8", "surrogatepass")),
            st.sampled_from(
                [
                    b"nan",
                    b"1e999",
                    b"-1",
                    b"9" * 5000,
                    b"9" * 400,
                    b"9" * 30,
                    b"[" * 5000,
                    b"&a [*a]",
                    b"!!x",
                ]
            ),
        )
    )
    path.write_bytes(content[:start] + filling + content[end:])
    only_engram_errors(drive.read)
    only_engram_errors(lambda: drive.read(skip_bad=True))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".pgm", ".bmp", ".tiff", ".webp"])
@mangling
@given(keep=st.floats(0, 1), place=st.floats(0, 1, exclude_max=True), flip=st.integers(0, 255))
def test_mangled_images_raise_nothing_but_our_errors(tmp_path_factory, suffix, keep, place, flip):
    path = tmp_path_factory.mktemp("mangled") / f"a{suffix}"
    write_image(path, picture(0, 0))
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= flip
    path.write_bytes(content[: int(keep * len(content))])
    only_engram_errors(lambda: read_image(path, WIDTH, HEIGHT))


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".jpeg", ".pgm", ".bmp", ".tiff", ".webp"])
def test_images_of_any_kind_are_read(tmp_path: Path, suffix: str) -> None:
    path = LAYOUTS["kitti"].write(tmp_path)
    smooth = cv2.GaussianBlur(picture(0, 0), (0, 0), 4)
    for index in range(PAIRS):
        for side in range(2):
            old = LAYOUTS["kitti"].image(path, index, side)
            old.unlink()
            write_image(old.with_suffix(suffix), smooth)
    for pair in open_drive(path):
        # JPEG and WebP lose a few grey levels, the others none.
        atol = 8 if suffix in {".jpg", ".jpeg", ".webp"} else 0
        np.testing.assert_allclose(pair.left.astype(int), smooth, atol=atol)


@pytest.mark.parametrize("number", ["9" * 5000, "9" * 400, "1e999", "nan"])
@pytest.mark.parametrize("name", ["fx = 40.0", "cx = 23.5", "width = 48", "baseline_m = 0.1"])
def test_absurd_numbers_in_a_calibration_are_refused(tmp_path, name: str, number: str) -> None:
    path = LAYOUTS["folder"].write(tmp_path)
    _edit(path / "calibration.toml", name, f"{name.partition(' ')[0]} = {number}")
    with pytest.raises(CalibrationError, match=r"calibration\.toml"):
        open_drive(path)


def test_a_gigapixel_first_image_does_not_set_the_size(tmp_path: Path) -> None:
    path = LAYOUTS["kitti"].write(tmp_path)
    _gigapixel(LAYOUTS["kitti"].image(path, 0, 0))
    drive = open_drive(path, skip_bad=True)
    assert (drive.camera.width, drive.camera.height) == (WIDTH, HEIGHT)
    assert len(list(drive)) == PAIRS - 1


class TestFirstHour:
    """What a newcomer tries first is refused with the cure, or simply works."""

    @pytest.mark.parametrize("name", ["kitti", "kitti-raw", "euroc"])
    def test_a_folder_above_drives_names_them(self, tmp_path: Path, name: str) -> None:
        path = LAYOUTS[name].write(tmp_path)
        (tmp_path / "notes.txt").write_text("sunny")
        with pytest.raises(SequenceError, match="contains some; name one of") as caught:
            open_drive(tmp_path)
        assert str(path) in str(caught.value)

    def test_many_drives_are_counted(self, tmp_path: Path) -> None:
        for number in range(12):
            (tmp_path / f"drive_{number:02d}" / "mav0" / "cam0").mkdir(parents=True)
        with pytest.raises(SequenceError, match="and 2 more"):
            open_drive(tmp_path)

    def test_frame_numbers_are_not_taken_for_stamps(self, tmp_path: Path) -> None:
        path = LAYOUTS["folder"].write(tmp_path)
        (path / "times.txt").unlink()
        for side in ("left", "right"):
            for index, file in enumerate(sorted((path / side).iterdir())):
                file.rename(file.with_name(f"{index:06d}.png"))
        with pytest.raises(SequenceError, match=r"000000\.png.*frame numbers.*times\.txt"):
            open_drive(path)
        (path / "times.txt").write_text("".join(f"{0.1 * i:.1f}\n" for i in range(PAIRS)))
        assert len(list(open_drive(path))) == PAIRS

    def test_9_comes_before_10(self, tmp_path: Path) -> None:
        path = LAYOUTS["folder"].write(tmp_path)
        padded = [pair.left.tobytes() for pair in open_drive(path)]
        for side in ("left", "right"):
            for index, file in enumerate(sorted((path / side).iterdir())):
                file.rename(file.with_name(f"frame{index + 8}.png"))
        assert [pair.left.tobytes() for pair in open_drive(path)] == padded

    def test_pairs_lost_on_both_sides_leave_later_stamps_alone(self, tmp_path: Path) -> None:
        path = LAYOUTS["folder"].write(tmp_path)
        stamps_ns = [pair.stamp_ns for pair in open_drive(path)]
        for side in ("left", "right"):
            files = sorted((path / side).iterdir())
            for index, file in enumerate(files):
                file.rename(file.with_name(f"{index}.png"))
            (path / side / "1.png").unlink()
        with pytest.raises(SequenceError, match="image 1 is missing"):
            open_drive(path)
        found = [pair.stamp_ns for pair in open_drive(path, skip_bad=True)]
        assert found == stamps_ns[:1] + stamps_ns[2:]

    def test_both_spellings_are_known(self, tmp_path: Path) -> None:
        path = LAYOUTS["kitti"].write(tmp_path)
        with pytest.raises(SequenceError, match="colour rig"):
            open_drive(path, rig="color")
        assert isinstance(open_drive(path, rig="gray", channel="gray"), ImageSequence)


def _folder(path: Path, frames: FrameRange) -> ImageSequence:
    return ImageSequence(find_folder(path, OpenOptions(frames=frames)), OpenOptions(frames=frames))


def _swapped(path: Path, options: OpenOptions) -> ImageSequence:
    found = find_folder(path, options)
    places = [
        one if isinstance(one, str) else replace(one, left=one.right, right=one.left)
        for one in found.places
    ]
    return ImageSequence(replace(found, places=places), options)


@pytest.mark.parametrize(
    ("broken", "demand"),
    [
        ({"recognises": lambda path: True}, "other files and folders"),
        ({"recognises": lambda path: False}, "it is recognised"),
        ({"open": lambda path, options: _folder(path, FrameRange())}, "--frames"),
        ({"open": _swapped}, "images are"),
        ({"open": SEQUENCES["euroc"].open}, "all pairs"),
    ],
)
def test_a_reader_that_breaks_the_contract_is_found_out(broken: dict, demand: str) -> None:
    layout = replace(SEQUENCES["folder"], **broken)
    found = unmet(check_reader("folder", layout, in_layout(LAYOUTS["folder"])))
    assert any(one.startswith(demand) for one in found), found
