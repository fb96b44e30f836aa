"""One changed file, text or hand-in, and values that are wrong or extreme."""

from __future__ import annotations

import json
import random
import re
import shutil
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import msgspec
import numpy as np

from engram.fleet.transfers import Manifest, PartHash, split
from engram.frontend.blobs import decode_landmarks
from engram.frontend.frame import Frame, FrameStatus, Landmarks
from engram.frontend.ranked import RankedLandmarks
from engram.geometry.se3 import SE3
from engram.graph.model import (
    Amendable,
    Anchor,
    Attempt,
    Clock,
    Edge,
    EdgeKind,
    Goal,
    Mark,
    Node,
    NodeId,
    Omission,
    PathEntry,
    PathEntryKind,
    Placement,
    Removal,
    Session,
    path_id,
)
from engram.maps.forgetting import Chosen, erase_map
from engram.maps.map import Map
from engram.maps.map_files import copy_map
from engram.maps.writer import RevisionWriter
from engram.odometry.step import OdometryStatus, OdometryStep
from engram.places.vocabulary import encode_vocabulary, one_word_vocabulary
from engram.sequences.framelog.file import FrameLogHeader
from engram.sequences.framelog.log_writer import FlightWriter, FrameLogWriter
from engram.sequences.sequence import LoggedFrame, SequenceInfo
from engram_lab.synthetic_places import (
    CAMERA,
    DESCRIPTOR,
    FRONTEND,
    drive_of,
    landmark_bytes,
    node_of,
)

_LANDMARKS = 12
_NODES = 4
_COVARIANCE = np.eye(6) * 1e-4


@dataclass(frozen=True, slots=True)
class Samples:
    """Files of every kind that strangers give."""

    town: Path
    logged: Path
    framelog: Path
    flight: Path
    manifest: Manifest
    parts: dict[PartHash, bytes]


def make_samples(folder: Path) -> Samples:
    """Makes them in a folder."""
    town, logged = folder / "town.engram", folder / "logged.engram"
    for _ in map_steps(town):
        pass
    _make_logged(town, logged)
    framelog, flight = folder / "drive.framelog", folder / "drive.flight"
    record_log(framelog)
    with FlightWriter(flight, _header()) as record:
        record.add_report({"reason": "lost", "robot": "r1"}, frames=_NODES, images=_NODES)
        _record(record)
    taken = split(town)
    names = [*taken.pages, *taken.blobs]
    parts = dict(zip(names, taken.parts(names), strict=True))
    return Samples(town, logged, framelog, flight, taken.manifest, parts)


def frame_of(stamp_ns: int) -> Frame:
    """A frame of a few random landmarks with a thumbnail, by its stamp."""
    blob = landmark_bytes(np.random.default_rng(stamp_ns), None, _LANDMARKS)
    picture = np.add.outer(np.arange(24), np.arange(32)).astype(np.uint8)
    landmarks = decode_landmarks(blob, CAMERA, DESCRIPTOR)
    return Frame(stamp_ns, CAMERA, landmarks, DESCRIPTOR, FRONTEND, FrameStatus.OK, picture)


def map_steps(path: Path) -> Iterator[str]:
    """Makes a map with rows in almost every table, naming each step once it is done."""
    with Map.create(path) as store:
        yield "create"
        first = yield from drive_steps(store, drive_of("r1", 1_000))
        yield from drive_steps(store, drive_of("r2", 2_000_000_000))
        yield from drive_steps(store, drive_of("r3", 4_000_000_000))
        with store.begin_revision(author="lab", message="marks", configuration={"a": 1}) as writer:
            for mark in _marks(first):
                writer.add_mark(mark)
            gone = node_of(drive_of("r4", 1), 1, 0.0).id
            writer.add_omission(Omission(gone, first[0], SE3.identity(), bytes(range(16))))
            writer.put_statistic("speed", {"mean": 1.5})
            writer.commit()
        yield "marks"
        words = encode_vocabulary(one_word_vocabulary(DESCRIPTOR))
        store.put_vocabulary(words, author="lab", message="words", configuration={})
        store.put_words(bytes(16), {node: np.array([3, 5, 700]) for node in first})
        yield "words"
        session = next(iter(store.sessions))
        store.amend(session, {Amendable.ROBOT: "renamed"}, author="lab")
        yield "amend"
        store.revert(2, author="lab", message="loose camera")
        yield "revert"
        store.tag("good", 1, author="lab", message="it works")
        store.tag("best", author="lab")
        yield "tag"
        expired = drive_of("r6", 8_000_000_000)
        yield from drive_steps(store, expired)
        chosen = Chosen(frozenset({expired.id}))
        store.forget_nodes(chosen, author="lab", message="expired", configuration={})
        yield "forget"
    erase_map(path)
    yield "erase"


def record_log(path: Path) -> None:
    """Records a frame log of a few frames."""
    with FrameLogWriter(path, _header()) as writer:
        _record(writer)


def _make_logged(town: Path, path: Path) -> None:
    """A copy of the map with one more revision and tag, which only the log contains."""
    draft = path.with_name("draft.engram")
    copy_map(town, draft)
    with Map.open(draft, writes=True) as store:
        for _ in drive_steps(store, drive_of("r5", 6_000_000_000)):
            pass
        store.tag("late", author="lab")
        for suffix in ("", "-wal"):  # before the last connection folds the log into the file
            shutil.copyfile(f"{draft}{suffix}", f"{path}{suffix}")


def drive_steps(store: Map, drive: Session) -> Generator[str, None, list[NodeId]]:
    """Adds a drive of a few nodes, with a checkpoint after the second."""
    writer = store.begin_session(
        drive,
        CAMERA,
        descriptor=DESCRIPTOR,
        frontend=FRONTEND,
        author=drive.robot,
        configuration={"mapper": {"distance_m": 1.0}},
    )
    nodes = [node_of(drive, drive.start_ns + at * 10**8, float(at)) for at in range(_NODES)]
    for at, node in enumerate(nodes):
        writer.add_node(node, frame_of(node.stamp_ns))
        entry = PathEntry(path_id(drive.id), at, node.id, PathEntryKind.SAVED, node.stamp_ns)
        writer.add_path_entry(entry)
        if at:
            _tie(writer, nodes[at - 1], node, at)
        if at == 1:
            writer.checkpoint()
            yield "checkpoint"
    writer.commit()
    yield "drive"
    return [node.id for node in nodes]


def _tie(writer: RevisionWriter, before: Node, node: Node, at: int) -> None:
    step = SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
    writer.add_edge(Edge(before.id, node.id, EdgeKind.ODOMETRY, step, _COVARIANCE))
    writer.add_attempts(
        [Attempt(at, before.id, node.id, 1.0, 0.0, 0.0, 0.25, 0.01, True, 30, 1, "distance")]
    )


def _marks(nodes: list[NodeId]) -> Iterator[Mark]:
    here = SE3.identity()
    yield Removal(nodes[0], nodes[1], EdgeKind.MATCH, here, "look-alike", 5)
    yield Placement(nodes[0], here)
    yield Anchor(nodes[1], 1.0, 2.0, None, 0.5, "survey")
    yield Goal("dock", nodes[2], here)


def _header() -> FrameLogHeader:
    info = SequenceInfo("drive", "kitti", Clock.UTC, "r1", 14.4, "Europe/Prague")
    return FrameLogHeader(info, CAMERA, DESCRIPTOR, FRONTEND, "odometry", "")


def _record(writer: FrameLogWriter) -> None:
    for at in range(_NODES):
        step = (
            OdometryStep(OdometryStatus.OK, SE3.identity(), _COVARIANCE, 50)
            if at
            else OdometryStep(OdometryStatus.FIRST)
        )
        frame = frame_of(1_000 + at * 10**8)
        ranked = None if isinstance(writer, FlightWriter) else _ranked(frame.landmarks)
        writer.append(LoggedFrame(frame, step), f"pair{at}", ranked)
        if isinstance(writer, FlightWriter):
            writer.add_decision({"status": "localised", "node": at})
            writer.add_images(*_images())


def _ranked(own: Landmarks) -> RankedLandmarks:
    """A frame's landmarks, and half of them again as later choices."""
    more = own.rows(slice(0, len(own), 2))
    return RankedLandmarks.joined(own, more, np.arange(len(own) + len(more), dtype=np.uint16))


def _images() -> tuple[bytes, bytes]:
    import cv2

    grey = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    return (cv2.imencode(".jpg", grey)[1].tobytes(),) * 2


class Subject(StrEnum):
    """What was changed."""

    MAP = "map"
    DRIVE = "drive"
    HANDIN = "hand-in"
    TEXT = "text"


@dataclass(frozen=True, slots=True)
class Case:
    """A changed thing.

    Attributes:
        sealed: whether it is sound in itself: its checksums were made right again, as a stranger
            does and damage never, or it is what the file once was.
        path: the file; None for a hand-in.
        manifest: of the hand-in, JSON; None for a file.
    """

    subject: Subject
    what: str
    sealed: bool = False
    path: Path | None = None
    manifest: Manifest | bytes | None = None
    parts: dict[PartHash, bytes] | None = None


# Changes a copy of a sample, made in the folder.
Change: TypeAlias = Callable[[Samples, Path, random.Random], Case]


_INTS = (0, 1, -1, 2, 127, 255, 65_535, 65_536, 2**31, -(2**31), 2**40, 2**62, 2**63 - 1, -(2**63))
_FLOATS = (0.0, -0.0, -1.0, 1e-320, 1e300, -1e300, float("inf"), float("-inf"))
_DEEP = 100_000


def integer(value: int, chance: random.Random) -> int:
    """Another number of 64 bits."""
    near = value + chance.choice([-1, 1, 256])
    return chance.choice([*_INTS, near if abs(near) < 2**62 else 0])


def real(value: float, chance: random.Random) -> float:
    """Another number, infinities included; SQLite keeps no NaN."""
    return chance.choice([*_FLOATS, value * 2, value + 1e-9])


def text(value: str, chance: random.Random) -> str:
    """Another text: empty, long, with control characters, or bad JSON."""
    wild = "\x1b]0;owned\x07\x1b[2J\u202e\r\n"
    made = [
        "",
        wild,
        value + wild,
        value[:-1],
        "x" * 1_000_000,
        "1" * 10_000,
        "[" * _DEEP,
        '{"a":' * _DEEP,
        '{"a": 1e999, "b": NaN}',
        '{"a": ' + "9" * 5_000 + "}",
        '{"a": ' + "[" * 900 + "]" * 900 + "}",
        '{"a": null, "merge": [], "nodes": "many", "frames": -1}',
        "null",
        '"\\ud800"',
        "\u0000",
        "../../etc/passwd",
    ]
    if value.startswith("{") and chance.random() < 0.5:
        return bent_json(value, chance)
    return chance.choice(made)


def bent_json(value: str, chance: random.Random) -> str:
    """The object with one value of another kind, anywhere in it."""
    content = json.loads(value)
    holders = [content]
    for one in holders:
        inner = one.values() if isinstance(one, dict) else one
        holders += [some for some in inner if isinstance(some, dict | list) and some]
    holder = chance.choice(holders)
    if not holder:
        return '{"merge": 1}'
    key = chance.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    holder[key] = chance.choice([None, -1, 2**70, 1e300, "x", [], {}, [[]], {"a": {}}, True])
    return json.dumps(content)


def blob(value: bytes, chance: random.Random) -> bytes:
    """Other bytes: flipped, cut, grown, not finite, or a large run."""
    match chance.randrange(7):
        case 0:
            return b""
        case 1:
            return value[: chance.randrange(len(value) + 1)]
        case 2:
            return value + chance.randbytes(chance.randint(1, 64))
        case 3:
            return np.full(len(value) // 8, chance.choice([np.nan, np.inf, 1e300])).tobytes()
        case 4 if chance.random() < 0.05:
            return bytes(64 * 2**20)
        case _:
            return flipped(value, chance)


def flipped(value: bytes, chance: random.Random) -> bytes:
    """A few bits changed."""
    if not value:
        return b"\0"
    body = bytearray(value)
    for _ in range(chance.choice([1, 1, 2, 8])):
        body[chance.randrange(len(body))] ^= 1 << chance.randrange(8)
    return bytes(body)


def landmarks(body: bytes, chance: random.Random) -> bytes:
    """A safetensors file whose header or arrays are wrong."""
    length = int.from_bytes(body[:8], "little")
    header, arrays = body[8 : 8 + length], body[8 + length :]
    match chance.randrange(6):
        case 0:
            header = flipped(header, chance)
        case 1:
            header = _bent_header(header.decode(), chance).encode()
        case 2:
            header = chance.choice([b"[" * _DEEP, b'{"a":' * _DEEP, b"{}", b""])
        case 3:
            arrays = flipped(arrays, chance)
        case 4:
            arrays = bytes(len(arrays))
        case _:
            length = chance.choice([0, 2**31, 2**63, 2**64 - 1, length + 1])
            return length.to_bytes(8, "little") + header + arrays
    return len(header).to_bytes(8, "little") + header + arrays


def _bent_header(header: str, chance: random.Random) -> str:
    """The header with a wrong value in it, or in the JSON that its own metadata hold."""
    about = json.loads(header).get("__metadata__", {})
    within = [key for key, value in about.items() if value.startswith("{")]
    if not within or chance.random() < 0.3:
        return bent_json(header, chance)
    about[within[0]] = bent_json(about[within[0]], chance)
    return json.dumps(json.loads(header) | {"__metadata__": about})


def picture(value: bytes, chance: random.Random) -> bytes:
    """A JPEG whose size is a lie, whose body is wrong, or another format."""
    body = bytearray(value)
    match chance.randrange(5):
        case 0:
            at = body.index(b"\xff\xc0")
            sides = chance.choice([(1024, 1024), (65_535, 65_535), (0, 0), (1, 1024)])
            body[at + 5 : at + 9] = b"".join(side.to_bytes(2, "big") for side in sides)
        case 1:
            second = b"\xff\xc0\x00\x0b\x08\xff\xff\xff\xff\x01\x01\x11\x00"
            at = chance.choice([2, body.index(b"\xff\xda")])
            body[at:at] = second
        case 2:
            return cv2.imencode(".png", np.zeros((8, 8), np.uint8))[1].tobytes()
        case 3:
            return bytes(body[:2]) + b"\xff\xe1\x00\x00" * chance.choice([1, 50_000])
        case _:
            return flipped(value, chance)
    return bytes(body)


def packed_attempts(value: bytes, chance: random.Random) -> bytes:
    """MessagePack of attempts with other contents, or depth, or promised lengths."""
    content: dict[str, Any] = msgspec.msgpack.decode(value)
    match chance.randrange(6):
        case 0:
            name = chance.choice(["base", "first"])
            content[name] = chance.choice([2**61, -(2**61), 2**62, 2**63 - 1])
        case 1:
            content["policies"] = chance.choice([[], ["\x1b[31m"], ["x"] * 100_000])
        case 2:
            content["nodes"] = blob(content["nodes"], chance)
        case 3:
            content["rows"] = blob(content["rows"], chance)
        case 4:
            return chance.choice(
                [b"\x91" * _DEEP, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff"]
            )
        case _:
            return flipped(value, chance)
    return msgspec.msgpack.encode(content)


_POSE = "[1, 0, 0, -0.12, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
_RECTIFIED = """\
clock = "utc"
robot = "r1"
zone = "Europe/Berlin"
[rectified]
fx = 718.9
fy = 718.9
cx = 607.2
cy = 185.2
baseline_m = 0.54
width = 1241
height = 376
"""
_LENS = 'fx = 450.0\nfy = 451.0\ncx = 320.0\ncy = 240.0\ndistortion = "radial-tangential"\n'
_RAW = f"""\
cam_from_rig = {_POSE}
[raw]
width = 640
height = 480
right_from_left = {_POSE}
[raw.left]
{_LENS}coefficients = [-0.28, 0.07, 0.0002, 0.00002]
[raw.right]
{_LENS}coefficients = [-0.28, 0.07, 0.0001, -0.00003]
"""
_KALIBR = """\
cam0:
  camera_model: pinhole
  intrinsics: [461.6, 460.3, 363.0, 248.1]
  distortion_model: radtan
  distortion_coeffs: [-0.28, 0.07, 0.0, 0.0]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.11]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  intrinsics: [460.7, 459.1, 367.2, 247.3]
  distortion_model: radtan
  distortion_coeffs: [-0.01, 0.02, 0.0, 0.0]
  resolution: [752, 480]
  rostopic: /cam1/image_raw
"""


def _camera_info(side: str, shift: float) -> str:
    return f"""\
image_width: 640
image_height: 480
camera_name: {side}
camera_matrix: {{rows: 3, cols: 3, data: [450, 0, 320, 0, 450, 240, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [-0.2, 0.05, 0.0, 0.0, 0.0]}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [440, 0, 320, {shift}, 0, 440, 240, 0, 0, 0, 1, 0]}}
"""


_MATRIX = "!!opencv-matrix\n  rows: {r}\n  cols: {c}\n  dt: d\n  data: [{d}]"
_OPENCV = "%YAML:1.0\n---\n" + "\n".join(
    f"{name}: " + _MATRIX.format(r=rows, c=columns, d=data)
    for name, rows, columns, data in (
        ("M1", 3, 3, "450., 0., 320., 0., 450., 240., 0., 0., 1."),
        ("D1", 1, 5, "-0.2, 0.05, 0., 0., 0."),
        ("M2", 3, 3, "451., 0., 321., 0., 451., 241., 0., 0., 1."),
        ("D2", 1, 5, "-0.2, 0.05, 0., 0., 0."),
        ("R", 3, 3, "1., 0., 0., 0., 1., 0., 0., 0., 1."),
        ("T", 3, 1, "-0.12, 0., 0."),
    )
)
_SETTINGS = """\
[mapper]
save_every_m = 2.0
[drive]
ranking = "recall"
lanes = 2
[frontend]
thumbnails = true
"""
# File → its sound text; a ROS pair is read by its left file.
CALIBRATIONS = {
    "calibration.toml": _RECTIFIED,
    "raw.toml": _RAW,
    "camchain.yaml": _KALIBR,
    "left.yaml": _camera_info("left", 0.0),
    "stereo.yml": f"{_OPENCV}\nimage_size: [640, 480]\n",
}
_LONGEST = 2_000_000  # characters: far more than anybody reads
ZONES = ("Europe/Berlin", "America/Argentina/Buenos_Aires", "Etc/GMT+3", "UTC")


def sound(folder: Path) -> list[Case]:
    """Every text as it is before a change."""
    (folder / "right.yaml").write_text(_camera_info("right", -52.8))
    whole = {**CALIBRATIONS, "settings.toml": _SETTINGS, "zone.txt": ZONES[0]}
    for name, text in whole.items():
        (folder / name).write_text(text)
    return [Case(Subject.TEXT, name, sealed=True, path=folder / name) for name in whole]


def of_a_calibration(_: Samples, folder: Path, chance: random.Random) -> Case:
    """A calibration of any format."""
    name = chance.choice(list(CALIBRATIONS))
    if name == "left.yaml":
        (folder / "right.yaml").write_text(_camera_info("right", -52.8))
    return _changed(folder / name, CALIBRATIONS[name], chance)


def of_settings(_: Samples, folder: Path, chance: random.Random) -> Case:
    """A file of settings."""
    return _changed(folder / "settings.toml", _SETTINGS, chance)


def of_a_zone(_: Samples, folder: Path, chance: random.Random) -> Case:
    """The name of a time zone, alone in a file."""
    return _changed(folder / "zone.txt", chance.choice(ZONES), chance)


def _changed(path: Path, text: str, chance: random.Random) -> Case:
    how = chance.choice(list(_WAYS))
    for _ in range(chance.choice([1, 1, 2, 4])):
        text = _WAYS[how](text, chance)[:_LONGEST]
        how = chance.choice(list(_WAYS))
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    return Case(Subject.TEXT, f"{path.name}: {how}", sealed=True, path=path)


def _flip(text: str, chance: random.Random) -> str:
    at = chance.randrange(len(text) + 1)
    return text[:at] + chr(chance.choice([*range(128), 0x85, 0x2028, 0xFEFF])) + text[at + 1 :]


def _cut(text: str, chance: random.Random) -> str:
    return text[: chance.randrange(len(text) + 1)]


def _value(text: str, chance: random.Random) -> str:
    """Another value in the place of one word or number."""
    places = list(re.finditer(r"[\w.+-]+", text))
    if not places:
        return text
    place = chance.choice(places)
    return text[: place.start()] + chance.choice(_VALUES) + text[place.end() :]


def _lines(text: str, chance: random.Random) -> str:
    """One line over and over, or elsewhere, or missing."""
    lines = text.splitlines(keepends=True) or [""]
    line = lines.pop(chance.randrange(len(lines)))
    at = chance.randrange(len(lines) + 1)
    lines[at:at] = [line] * chance.choice([0, 1, 2, min(3_000, _LONGEST // (len(line) + 1))])
    return "".join(lines)


def _aliases(text: str, chance: random.Random) -> str:
    """A short text that aliases make long, in the place of a value or in addition to all."""
    depth, width = chance.choice([(1, 1), (3, 3), (9, 9), (30, 2), (2, 3_000)])
    bomb = [f"a0: &a0 [{', '.join(['x'] * width)}]"]
    bomb += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * width)}]" for n in range(1, depth + 1)]
    names = re.findall(r"^ *([a-z_]+):", text, re.M) or ["x"]
    name = chance.choice(names)
    bent = re.sub(rf"({name}:).*", rf"\1 *a{depth}", text, count=chance.randint(0, 1))
    loop = chance.choice(["", f"{name}: &b [*b]\n", "<<: *a0\n"])
    return "\n".join(bomb) + "\n" + loop + bent


def _keys(text: str, chance: random.Random) -> str:
    """A key of many parts, or very long, or in many tables."""
    count = chance.choice([3, 60, 99, 5_000, 190_000])
    part = chance.choice(["a", '"a"', "a ", "'b'"])
    dotted = ".".join([part] * count)[:399_000].rstrip(". ")
    made = [
        f"{dotted} = 1\n",
        f"[{dotted}]\nx = 1\n",
        f"x = {{{dotted} = 1}}\n",
        f"{'k' * count} = 1\n",
        f"{'k' * count}: 1\n",
        "".join(f"[t{n}]\n" for n in range(min(count, 20_000))),
        "".join(f"[[t]]\n[t.u{n}]\n" for n in range(min(count, 20_000))),
        "".join(f"a.b{n}.c = 1\n" for n in range(min(count, 20_000))),
        f"x = {'{a = ' * min(count, 60_000)}",
        f"x = '{'.' * count}'\n",
    ]
    return chance.choice(made) + text


def _deep(text: str, chance: random.Random) -> str:
    """Depth or length in one place."""
    count = chance.choice([2, 50, 900, 20_000, 99_000])
    grown = [
        "[" * count,
        "[" * count + "]" * count,
        "{" * count,
        "{a: " * count,
        "- " * count,
        "? " * count,
        "a: " * count,
        "&a " * count,
        "!a " * count,
        '"' * count,
        "'" * count,
        '"""\\"' * (count // 4),
        " " * count,
        "\t" * count,
        "\n" * count,
        "#" * count,
        "|\n" * count,
        "x: |\n " * (count // 4),
        "---\n" * (count // 4),
        "1," * count,
        "9" * count,
        "0x" + "f" * count,
        "1e" + "9" * min(count, 400),
        '"' + "\\n" * count + '"',
        '"' + "\\U0010ffff" * (count // 10) + '"',
    ]
    at = chance.choice([0, len(text), chance.randrange(len(text) + 1)])
    sign = chance.choice(["", "", " = ", ": ", "\nx = ", "\nx: "])
    return text[:at] + sign + chance.choice(grown) + text[at:]


_VALUES = (
    "", "null", "~", "true", "nan", "inf", "-inf", "-1", "0", "1e999", "1e308", "1e-320", "0x7f",
    "9" * 400, "9" * 5_000, "x", "[]", "{}", "[[]]", "*a", "&a", "!!python/object:os.system x",
    "!!binary aGk=", "!!float x", "2001-01-01", "12:30:45", "1_000", "0b1", "0o7", "640.5", "1e6",
    "../../etc/passwd", "localtime", "posixrules", "Europe", "zone.tab", "x" * 10_000, "\\0",
    "fisheye", "equidistant", "none", "pinhole", "radtan", "\u202e", "\x1b[2J",
)  # fmt: skip
_WAYS: dict[str, Callable[[str, random.Random], str]] = {
    "flip": _flip,
    "cut": _cut,
    "value": _value,
    "lines": _lines,
    "aliases": _aliases,
    "keys": _keys,
    "deep": _deep,
}
