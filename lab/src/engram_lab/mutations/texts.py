"""Changes of texts that come with drives and maps: calibrations, settings, zones."""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from pathlib import Path

from engram_lab.mutations.case import Case, Samples, Subject

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
