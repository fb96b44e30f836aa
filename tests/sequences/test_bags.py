"""Bags as drives: containers, encodings, topics, pairs, damage."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from engram.errors import (
    CalibrationError,
    ConfigError,
    EngramError,
    MissingExtraError,
    SequenceError,
)
from engram.graph.model import Clock
from engram.sequences.bags import messages
from engram.sequences.bags.bag_sequence import BagSequence, describe_bag, learnt_tolerance
from engram.sequences.bags.containers import Bag
from engram.sequences.opening import open_drive

from .bag_maker import (
    KINDS,
    LEFT,
    RIGHT,
    StereoBag,
    bag,
    bare_file,
    made,
    rectified_infos,
    split,
)
from .synthetic import HEIGHT, PAIRS, PERIOD_NS, START_NS, WIDTH, camera, picture, stamp_ns

PICTURES = [(stamp_ns(index), picture(index, 0), picture(index, 1)) for index in range(PAIRS)]
WHOLE = StereoBag(PICTURES, rectified_infos(camera()))


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


def opened(path: Path, **options) -> BagSequence:
    sequence = open_drive(path, **options)
    assert isinstance(sequence, BagSequence)
    return sequence


def stamped(folder: Path, off_ns: Callable[[int, int], int]) -> BagSequence:
    """A bag of 24 pairs, each of its number in grey, whose stamps are off, by side and number."""
    folder.mkdir(exist_ok=True)
    with bag(folder / "b", "mcap") as maker:
        for side, topic in enumerate((LEFT, RIGHT)):
            info = topic.replace("image_raw", "camera_info")
            maker.info(info, START_NS, rectified_infos(camera())[side])
        for number in range(24):
            for side, topic in enumerate((LEFT, RIGHT)):
                image, true_ns = np.full((HEIGHT, WIDTH), number, np.uint8), stamp_ns(number)
                wrong_ns = true_ns + off_ns(side, number)
                maker.image(topic, wrong_ns, image, received_ns=true_ns)
    return opened(made(folder / "b", "mcap"))


def assert_whole(sequence: BagSequence) -> None:
    pairs = list(sequence)
    assert [pair.stamp_ns for pair in pairs] == [stamp for stamp, *_ in PICTURES]
    for pair, (_, left, right) in zip(pairs, PICTURES, strict=True):
        np.testing.assert_array_equal(pair.left, left)
        np.testing.assert_array_equal(pair.right, right)
    assert sequence.lost == []


class TestContainers:
    @pytest.mark.parametrize("png", [False, True])
    def test_frames_are_those_that_were_written(self, tmp_path, kind, png) -> None:
        written = StereoBag(PICTURES, rectified_infos(camera()), png=png)
        sequence = opened(written.write(tmp_path / "monday", kind))
        assert len(sequence) == PAIRS
        assert sequence.camera == camera()
        assert sequence.info.clock is Clock.UTC
        assert sequence.info.name == "monday"
        assert_whole(sequence)
        assert_whole(sequence)  # a second pass gives the same

    def test_the_bare_file_is_a_drive_too(self, tmp_path, kind) -> None:
        WHOLE.write(tmp_path / "monday", kind)
        assert_whole(opened(bare_file(tmp_path / "monday", kind)))

    @pytest.mark.parametrize(
        ("kind", "compress"),
        [
            ("ros1", "bz2"),
            ("ros1", "lz4"),
            ("sqlite", "message"),
            ("sqlite", "file"),
            ("mcap", "storage"),
            ("mcap", "file"),
        ],
    )
    def test_compressed_ones(self, tmp_path, kind, compress) -> None:
        assert_whole(opened(WHOLE.write(tmp_path / "monday", kind, compress=compress)))

    def test_the_files_of_a_split_bag_are_one_drive(self, tmp_path, kind) -> None:
        files = []
        for part, pairs in enumerate((PICTURES[:4], PICTURES[4:])):
            path = tmp_path / f"part{part}"
            StereoBag(pairs, rectified_infos(camera())).write(path, kind)
            files.append(bare_file(path, kind))
        assert_whole(opened(split(tmp_path / "monday", files)))

    def test_two_bags_in_a_folder_are_two_drives(self, tmp_path) -> None:
        for name in ("monday", "tuesday"):
            WHOLE.write(tmp_path / name, "ros1")
        with pytest.raises(SequenceError, match=r"(?s)contains some.*monday\.bag.*tuesday\.bag"):
            open_drive(tmp_path)

    def test_messages_are_those_of_rosbags(self, tmp_path, kind) -> None:
        from rosbags.highlevel import AnyReader

        path = WHOLE.write(tmp_path / "monday", kind)
        with AnyReader([path]) as reader:
            wanted = [(one.topic, at, bytes(data)) for one, at, data in reader.messages()]
            counts = {name: topic.msgcount for name, topic in reader.topics.items()}
        ours = Bag(path)
        found = [(one.topic, one.received_ns, bytes(one.data)) for one in ours.records()]
        assert sorted(found) == sorted(wanted)
        assert {name: topic.count for name, topic in ours.topics.items()} == counts

    def test_the_order_of_the_file_does_not_matter(self, tmp_path, kind) -> None:
        with bag(tmp_path / "apart", kind) as maker:
            for side, topic in enumerate((LEFT, RIGHT)):
                for stamp, *images in PICTURES:
                    maker.image(topic, stamp, images[side])
                info = topic.replace("image_raw", "camera_info")
                maker.info(info, START_NS, rectified_infos(camera())[side])
        assert_whole(opened(made(tmp_path / "apart", kind)))


def test_a_bag_cut_before_the_right_images_says_so(tmp_path) -> None:
    with bag(tmp_path / "apart", "ros1") as maker:
        for side, topic in enumerate((LEFT, RIGHT)):
            for stamp, *images in PICTURES:
                maker.image(topic, stamp, images[side])
    path = tmp_path / "apart.bag"
    content = path.read_bytes()
    cut = content.index(PICTURES[0][2].tobytes())
    path.write_bytes(content[:cut])
    with pytest.raises(SequenceError, match=r"no image can be read; .*cut short"):
        open_drive(path)


def colours() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


BGR = colours()
GREY = cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY)
MONO16 = GREY.astype(np.uint16) * 257
OPAQUE = np.full((HEIGHT, WIDTH, 1), 255, np.uint8)


def mosaic(pattern: str) -> np.ndarray:
    """A Bayer image of one colour: every pixel of a channel has one value."""
    values = {"r": 50, "g": 100, "b": 200}
    tile = np.array([values[one] for one in pattern], np.uint8).reshape(2, 2)
    return np.tile(tile, (HEIGHT // 2, WIDTH // 2))


class TestEncodings:
    @pytest.mark.parametrize(
        ("encoding", "image", "wanted"),
        [
            ("mono8", GREY, GREY),
            ("8UC1", GREY, GREY),
            ("mono16", MONO16, GREY),
            ("16UC1", MONO16, GREY),
            ("bgr8", BGR, GREY),
            ("rgb8", BGR[:, :, ::-1], GREY),
            ("bgra8", np.concatenate([BGR, OPAQUE], axis=2), GREY),
            ("rgba8", np.concatenate([BGR[:, :, ::-1], OPAQUE], axis=2), GREY),
            ("yuv422", np.stack([GREY // 3, GREY], axis=2), GREY),
            ("yuv422_yuy2", np.stack([GREY, GREY // 3], axis=2), GREY),
            *(
                (f"bayer_{pattern}8", mosaic(pattern), None)
                for pattern in ("rggb", "bggr", "gbrg", "grbg")
            ),
            ("bayer_rggb16", mosaic("rggb").astype(np.uint16) * 257, None),
        ],
    )
    def test_they_all_become_grey(self, tmp_path, encoding, image, wanted) -> None:
        path = self.write(tmp_path, image, encoding)
        found = next(iter(opened(path))).left
        if wanted is None:
            luma = round(0.299 * 50 + 0.587 * 100 + 0.114 * 200)
            np.testing.assert_allclose(found[2:-2, 2:-2], luma, atol=1)
        else:
            np.testing.assert_array_equal(found, wanted)

    def test_big_endian_pixels(self, tmp_path) -> None:
        path = self.write(tmp_path, MONO16, "mono16", big_endian=True)
        np.testing.assert_array_equal(next(iter(opened(path))).left, GREY)

    @pytest.mark.parametrize("bits", [10, 12])
    def test_cameras_that_use_fewer_than_16_bits_are_not_dark(self, tmp_path, bits) -> None:
        white = (1 << bits) - 1
        grey = (GREY.astype(np.uint32) * white // 255).astype(np.uint16)
        grey[0, 0] = white
        found = next(iter(opened(self.write(tmp_path, grey, "16UC1")))).left
        np.testing.assert_allclose(found[1:].astype(int), GREY[1:], atol=1)

    @pytest.mark.parametrize(("format_", "suffix"), [("jpeg", ".jpg"), ("mono8; png", ".png")])
    def test_compressed_images(self, tmp_path, format_, suffix) -> None:
        smooth = cv2.GaussianBlur(GREY, (0, 0), 4)
        ok, content = cv2.imencode(suffix, smooth)
        assert ok
        with bag(tmp_path / "b", "mcap") as maker:
            for side, topic in enumerate((LEFT, RIGHT)):
                maker.compressed(topic + "/compressed", START_NS, content.tobytes(), format_)
                info = topic.replace("image_raw", "camera_info")
                maker.info(info, START_NS, rectified_infos(camera())[side])
        found = next(iter(opened(tmp_path / "b"))).left
        np.testing.assert_allclose(found.astype(int), smooth, atol=8 if suffix == ".jpg" else 0)

    def test_one_channel_of_a_colour_image(self, tmp_path) -> None:
        path = self.write(tmp_path, BGR, "bgr8")
        found = next(iter(opened(path, channel="red"))).left
        np.testing.assert_array_equal(found, BGR[:, :, 2])

    def test_a_grey_image_has_no_channel(self, tmp_path) -> None:
        with pytest.raises(ConfigError, match="channel"):
            list(opened(self.write(tmp_path, GREY, "mono8"), channel="red"))

    def test_an_unknown_one_is_named_with_the_known(self, tmp_path) -> None:
        path = self.write(tmp_path, GREY, "32FC1")
        with pytest.raises(SequenceError, match=r"encoding is '32fc1'; known are mono8"):
            list(opened(path))

    @staticmethod
    def write(folder: Path, image: np.ndarray, encoding: str, **options) -> Path:
        with bag(folder / "b", "mcap") as maker:
            for side, topic in enumerate((LEFT, RIGHT)):
                maker.image(topic, START_NS, image, encoding, **options)
                info = topic.replace("image_raw", "camera_info")
                maker.info(info, START_NS, rectified_infos(camera())[side])
        return folder / "b"


def named(folder: Path, *names: str) -> Path:
    """A bag with the same images on all these topics, and a calibration for each."""
    with bag(folder / "named", "mcap") as maker:
        infos = set()
        for name in names:
            right = any(word in name for word in ("right", "infra2", "cam1", "starboard"))
            maker.image(name, START_NS, picture(0, int(right)))
            info = name.rsplit("/", 1)[0] + "/camera_info"
            if info not in infos:
                maker.info(info, START_NS, rectified_infos(camera())[right])
            infos.add(info)
    return folder / "named"


class TestTopics:
    @pytest.mark.parametrize(
        ("left", "right"),
        [
            ("/stereo/left/image_raw", "/stereo/right/image_raw"),
            ("/left/image_rect", "/right/image_rect"),
            ("/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"),
            ("/cam0/image_raw", "/cam1/image_raw"),
            ("/robot7/port/image", "/robot7/starboard/image"),
            ("/zed/zed_node/left/image_rect_color", "/zed/zed_node/right/image_rect_color"),
            ("/zed/zed_node/left_raw/image_raw_color", "/zed/zed_node/right_raw/image_raw_color"),
            ("/stereo/left/image_raw/compressed", "/stereo/right/image_raw/compressed"),
        ],
    )
    def test_usual_names_are_found(self, tmp_path, left, right) -> None:
        others = ("/camera/depth/left/image", "/camera/depth/right/image", "/front/image")
        if left.endswith("compressed"):
            path = StereoBag(PICTURES, rectified_infos(camera()), png=True).write(
                tmp_path / "b", "mcap"
            )
        else:
            path = named(tmp_path, left, right, *others)
        topics = opened(path).topics
        assert (topics.left, topics.right) == (left, right)

    def test_of_one_camera_the_rectified_is_taken(self, tmp_path) -> None:
        sides = ("left", "right")
        kinds = ("image_raw", "image_rect_color", "image_rect")
        path = named(tmp_path, *(f"/front/{side}/{kind}" for side in sides for kind in kinds))
        assert opened(path).topics.left == "/front/left/image_rect"

    def test_two_rigs_are_a_question_with_the_answers(self, tmp_path) -> None:
        rigs = ("front", "rear")
        names = [f"/{rig}/{side}/image_raw" for rig in rigs for side in ("left", "right")]
        path = named(tmp_path, *names)
        with pytest.raises(SequenceError, match="2 stereo pairs; choose one with") as caught:
            open_drive(path)
        for rig in rigs:
            line = f"--left /{rig}/left/image_raw --right /{rig}/right/image_raw"
            assert line in str(caught.value)
        for options in (
            {"left": "/rear/left/image_raw"},
            {"left": "/rear/left/image_raw", "right": "/rear/right/image_raw"},
        ):
            assert opened(path, **options).topics.right == "/rear/right/image_raw"

    def test_no_pair_lists_what_there_is(self, tmp_path) -> None:
        path = named(tmp_path, "/front/image", "/rear/image", "/roof/image")
        with pytest.raises(SequenceError, match=r"(?s)--left TOPIC.*/front/image.*/rear/image"):
            open_drive(path)
        assert describe_bag(path).command.endswith("--left TOPIC --right TOPIC")

    def test_two_topics_are_offered_as_the_pair(self, tmp_path) -> None:
        path = named(tmp_path, "/eye_a/image", "/eye_b/image", "/camera/depth/image")
        offered = "--left /eye_a/image --right /eye_b/image"
        with pytest.raises(SequenceError, match=offered):
            open_drive(path)
        assert describe_bag(path).command.endswith(offered)

    def test_one_camera_is_not_enough(self, tmp_path) -> None:
        path = named(tmp_path, "/camera/color/image_raw", "/camera/depth/image")
        with pytest.raises(SequenceError, match="one camera only"):
            open_drive(path)
        assert describe_bag(path).command == "", "no option helps"

    def test_a_topic_that_is_not_there_or_no_image(self, tmp_path) -> None:
        path = WHOLE.write(tmp_path / "b", "mcap")
        with pytest.raises(SequenceError, match="--left /nowhere: the bag has no such topic"):
            open_drive(path, left="/nowhere")
        with pytest.raises(SequenceError, match="holds sensor_msgs/msg/CameraInfo, not images"):
            open_drive(path, right="/stereo/right/camera_info")

    def test_topics_are_for_bags(self, tmp_path, street) -> None:
        with pytest.raises(ConfigError, match="topics of a bag"):
            open_drive(street, left="/left/image")


class TestPairs:
    def test_the_tolerance_follows_the_bag(self) -> None:
        left = list(range(0, 10_000_000_000, 50_000_000))
        for offset_ns, wanted_ns in ((0, 100_000), (20_000, 100_000), (1_000_000, 3_000_000)):
            right = [stamp + offset_ns for stamp in left]
            assert learnt_tolerance(left, right, 5_000_000) == wanted_ns

    def test_it_stays_below_half_an_interval(self) -> None:
        left = list(range(0, 1_000_000_000, 4_000_000))
        assert learnt_tolerance(left, [stamp + 1_900_000 for stamp in left], 5_000_000) == 2_000_000

    def test_images_of_two_instants_are_no_pair(self, tmp_path) -> None:
        late = StereoBag(PICTURES, rectified_infos(camera()), offset_ns=30_000_000)
        with pytest.raises(SequenceError, match=r"not synchronised: typically 30\.0 ms apart"):
            open_drive(late.write(tmp_path / "b", "mcap"))

    def test_a_lost_image_loses_its_pair_only(self, tmp_path, kind) -> None:
        with bag(tmp_path / "gaps", kind) as maker:
            for number, (stamp, left, right) in enumerate(PICTURES):
                if number != 1:
                    maker.image(LEFT, stamp, left)
                if number != 3:
                    maker.image(RIGHT, stamp + 40_000, right)
            for side, topic in enumerate((LEFT, RIGHT)):
                info = topic.replace("image_raw", "camera_info")
                maker.info(info, START_NS, rectified_infos(camera())[side])
        sequence = opened(made(tmp_path / "gaps", kind))
        pairs = list(sequence)
        assert [pair.stamp_ns for pair in pairs] == [stamp_ns(index) for index in (0, 2, 4, 5)]
        np.testing.assert_array_equal(pairs[1].right, PICTURES[2][2])
        assert (sequence.pairing.left, sequence.pairing.paired) == (5, 4)
        assert sequence.pairing.largest_offset_ns == 40_000
        assert "4 of 5 left images paired (80.0 %), at most 0.040 ms apart" in (
            sequence.pairing.text()
        )

    def test_stamps_that_go_back_are_left_out(self, tmp_path) -> None:
        shuffled = [PICTURES[index] for index in (0, 2, 1, 3)]
        sequence = opened(StereoBag(shuffled, WHOLE.infos).write(tmp_path / "b", "mcap"))
        assert [pair.stamp_ns for pair in sequence] == [stamp_ns(index) for index in (0, 2, 3)]
        assert sequence.stamps.early == 1

    @pytest.mark.parametrize("sides", [(0, 1), (0,), (1,)])
    @pytest.mark.parametrize("by_s", [-0.5, -3600.0])
    def test_a_clock_that_is_set_back_costs_no_pair(self, tmp_path, sides, by_s) -> None:
        drive = stamped(tmp_path, lambda side, n: round(by_s * 10**9) * (side in sides and n >= 12))
        pairs = list(drive)
        assert [int(pair.left[0, 0]) for pair in pairs] == list(range(24))
        assert [int(pair.right[0, 0]) for pair in pairs] == list(range(24))
        times_ns = np.array([pair.stamp_ns for pair in pairs])
        np.testing.assert_allclose(np.diff(times_ns), PERIOD_NS)
        assert "the clock went back" in " ".join(drive.stamp_facts)

    @pytest.mark.parametrize("sides", [(0, 1), (0,), (1,)])
    @pytest.mark.parametrize("at", [0, 7, 23])
    def test_a_wrong_stamp_costs_its_own_pair(self, tmp_path, sides, at) -> None:
        hour_ns = 3600 * 10**9
        drive = stamped(tmp_path, lambda side, n: hour_ns * (side in sides and n == at))
        pairs = list(drive)
        kept = [n for n in range(24) if n != at]
        assert [int(pair.left[0, 0]) for pair in pairs] == kept
        assert [int(pair.right[0, 0]) for pair in pairs] == kept
        assert "1 of 24" in drive.stamp_facts[0]

    def test_a_zero_is_wrong_where_other_stamps_are_not(self, tmp_path) -> None:
        """In simulation the recorder's clock is another one."""
        drive = stamped(tmp_path, lambda _, n: -stamp_ns(n) if n == 6 else 12 * 10**9 - START_NS)
        assert len(list(drive)) == 23
        assert drive.stamps.early == 1
        unstamped = stamped(tmp_path / "none", lambda _, n: -stamp_ns(n))
        assert [pair.stamp_ns for pair in unstamped] == [stamp_ns(n) for n in range(24)]

    def test_frames_and_times(self, tmp_path) -> None:
        path = WHOLE.write(tmp_path / "b", "mcap")

        def numbers(**options) -> list[int]:
            return [(pair.stamp_ns - START_NS) // PERIOD_NS for pair in opened(path, **options)]

        assert numbers(frames="1::2") == [1, 3, 5]
        assert numbers(from_=0.2, to="0.4") == [2, 3, 4]
        assert numbers(from_="2014-05-13T16:53:20.3Z") == [3, 4, 5]
        assert numbers(from_="0.2", frames="1::2") == [3, 5]


class TestDamage:
    @pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
    def test_a_truncated_bag_gives_what_it_still_holds(self, tmp_path, kind, share) -> None:
        pairs = [(stamp_ns(index), picture(index, 0), picture(index, 1)) for index in range(400)]
        StereoBag(pairs, WHOLE.infos).write(tmp_path / "b", kind)
        file = bare_file(tmp_path / "b", kind)
        os.truncate(file, int(file.stat().st_size * share))
        sequence = opened(file)
        found = list(sequence)
        assert 0 < len(found) < 400
        for pair, (stamp, left, right) in zip(found, pairs, strict=False):
            assert pair.stamp_ns == stamp
            np.testing.assert_array_equal(pair.left, left)
            np.testing.assert_array_equal(pair.right, right)
        assert sequence.lost
        assert str(file) in sequence.lost[0]

    def test_a_message_of_another_type_is_left_out(self, tmp_path) -> None:
        with bag(tmp_path / "b", "mcap") as maker:
            for stamp, left, right in PICTURES:
                maker.image(LEFT, stamp, left)
                maker.image(RIGHT, stamp, right)
            for side, topic in enumerate((LEFT, RIGHT)):
                info = topic.replace("image_raw", "camera_info")
                maker.info(info, START_NS, rectified_infos(camera())[side])
            maker._writer.write(maker._connections[LEFT], stamp_ns(9), b"\0\1\0\0junk")
        sequence = opened(tmp_path / "b")
        assert len(list(sequence)) == PAIRS

    def test_an_image_of_another_size_is_left_out_and_told(self, tmp_path) -> None:
        pairs = [*PICTURES[:3], (stamp_ns(3), np.zeros((8, 8), np.uint8), picture(3, 1))]
        sequence = opened(StereoBag(pairs, WHOLE.infos).write(tmp_path / "b", "mcap"))
        assert len(list(sequence)) == 3
        assert sequence.skipped == 1
        assert "the image is 8×8 px, the calibration says 48×32" in sequence.lost[0]

    @pytest.mark.parametrize("content", [b"", b"#ROSBAG V1.2\n", b"\0" * 5000])
    @pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
    def test_something_else_with_the_name_of_a_bag(self, tmp_path, suffix, content) -> None:
        path = tmp_path / f"b{suffix}"
        path.write_bytes(content)
        with pytest.raises(SequenceError, match=str(path)):
            open_drive(path)

    def test_a_huge_image_is_not_decoded(self, tmp_path) -> None:
        header = cv2.imencode(".png", picture(0, 0))[1].tobytes()
        huge = header[:16] + (100_000).to_bytes(4, "big") * 2 + header[24:]
        with bag(tmp_path / "b", "mcap") as maker:
            for side, topic in enumerate((LEFT, RIGHT)):
                maker.compressed(topic + "/compressed", START_NS, huge)
                info = topic.replace("image_raw", "camera_info")
                maker.info(info, START_NS, rectified_infos(camera())[side])
        with pytest.raises(EngramError, match="100000×100000"):
            list(opened(tmp_path / "b"))


class TestCalibration:
    def test_without_one_the_option_is_named(self, tmp_path) -> None:
        path = StereoBag(PICTURES, None).write(tmp_path / "b", "mcap")
        with pytest.raises(CalibrationError, match=r"no CameraInfo.*--calibration FILE"):
            open_drive(path)

    def test_the_only_two_are_taken_wherever_they_are(self, tmp_path) -> None:
        left, right = rectified_infos(camera())
        with bag(tmp_path / "b", "mcap") as maker:
            for side, (name, info) in enumerate([("b", left), ("a", right)]):
                maker.image((LEFT, RIGHT)[side], START_NS, picture(0, side))
                maker.info(f"/calib/{name}", START_NS, info)
        assert opened(tmp_path / "b").camera.baseline_m == pytest.approx(camera().baseline_m)

    def test_those_of_other_topics_are_named(self, tmp_path) -> None:
        with bag(tmp_path / "b", "mcap") as maker:
            for side in (0, 1):
                maker.image((LEFT, RIGHT)[side], START_NS, picture(0, side))
            maker.info("/calib/a", START_NS, rectified_infos(camera())[0])
        with pytest.raises(CalibrationError, match=r"those of /calib/a belong to other topics"):
            open_drive(tmp_path / "b")

    def test_swapped_topics_are_told(self, tmp_path) -> None:
        path = WHOLE.write(tmp_path / "b", "mcap")
        with pytest.raises(CalibrationError, match="are left and right swapped"):
            open_drive(path, left=RIGHT, right=LEFT)

    def test_one_of_other_images_is_refused(self, tmp_path) -> None:
        infos = tuple({**info, "width": 640, "height": 480} for info in WHOLE.infos)
        path = StereoBag(PICTURES, infos).write(tmp_path / "b", "mcap")
        with pytest.raises(CalibrationError, match=r"640×480 px, the images of .* are 48×32"):
            open_drive(path)

    def test_without_the_extra_the_command_is_named(self, tmp_path, monkeypatch) -> None:
        path = WHOLE.write(tmp_path / "b", "mcap")
        messages._store.cache_clear()
        monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
        with pytest.raises(MissingExtraError, match=r"pip install 'engram-localisation\[bags\]'"):
            open_drive(path)
        messages._store.cache_clear()
