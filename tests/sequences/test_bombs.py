"""Files of a few bytes that would become much: refused by what they claim, before it is made."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest

from engram.calibration.formats import read_calibration
from engram.config import load_toml, read_toml
from engram.errors import CalibrationError, ConfigError, SequenceError
from engram.robot.anchors import GivenAnchor, on_grid
from engram.robot.settings import Settings
from engram.sequences.images import decoded, header_size

SIDE = 30_000  # 0.9 gigapixels


def png() -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + check

    header = struct.pack(">IIBBBBB", SIDE, SIDE, 8, 0, 0, 0, 0)
    body = zlib.compress(bytes(1000))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", body)


def tiff() -> bytes:
    tags = [
        (256, 4, SIDE), (257, 4, SIDE), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8),
        (277, 3, 1), (278, 4, SIDE), (279, 4, 100),
    ]  # fmt: skip
    rows = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + rows + bytes(4)


def sun_raster() -> bytes:
    return struct.pack(">8I", 0x59A66A95, SIDE, SIDE, 8, SIDE * SIDE, 1, 0, 0) + bytes(100)


def pfm() -> bytes:
    return f"Pf\n{SIDE} {SIDE}\n-1.0\n".encode() + bytes(100)


def jpeg_2000() -> bytes:
    body = bytearray(cv2.imencode(".jp2", np.zeros((64, 64), np.uint8))[1].tobytes())
    struct.pack_into(">II", body, body.find(b"ihdr") + 4, SIDE, SIDE)
    at = body.find(b"\xff\x4f\xff\x51")
    for offset in (8, 24):
        struct.pack_into(">II", body, at + offset, SIDE, SIDE)
    return bytes(body)


@pytest.mark.parametrize(
    "ending", ["png", "jpg", "bmp", "pgm", "tiff", "webp", "jp2", "avif", "ras"]
)
@pytest.mark.parametrize("shape", [(48, 64), (48, 64, 3)])
def test_the_header_says_what_is_decoded(ending, shape):
    picture = (np.arange(np.prod(shape)) % 251).astype(np.uint8).reshape(shape)
    if ending == "pgm" and len(shape) == 3:
        ending = "ppm"
    content = cv2.imencode(f".{ending}", picture)[1].tobytes()
    assert header_size(content) == (64, 48)
    assert decoded(ending, content, (64, 48)).shape[:2] == (48, 64)


@pytest.mark.parametrize("bomb", [png, tiff, sun_raster, pfm, jpeg_2000])
def test_a_small_image_that_claims_a_gigapixel_is_not_decoded(bomb):
    with pytest.raises(SequenceError, match=r"claims 30000×30000 px.*not decoded|not a readable"):
        decoded("bomb", bomb())


LENS = """\
  camera_model: {camera}
  intrinsics: [450, 450, 320, 240]
  distortion_model: {lens}
  distortion_coeffs: [0, 0, 0, 0]
  resolution: [640, 480]
"""


def aliases(depth: int, width: int = 10) -> str:
    lines = [f"a0: &a0 [{', '.join(['x'] * width)}]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * width)}]" for n in range(1, depth + 1)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("camera", "lens"), [("*a9", "radtan"), ("pinhole", "*a9"), ("pinhole", "radtan")]
)
def test_aliases_are_not_written_out(tmp_path, camera, lens):
    path = tmp_path / "camchain.yaml"
    path.write_text(aliases(9) + "cam0:\n" + LENS.format(camera=camera, lens=lens) + "cam1: {}\n")
    with pytest.raises(CalibrationError, match="aliases expand to too much text"):
        read_calibration(path)


@pytest.mark.parametrize("loop", ["cam0: &a [*a]\n", "cam0: &a {camera_model: *a}\n"])
def test_an_alias_that_holds_itself_is_refused(tmp_path, loop):
    path = tmp_path / "camchain.yaml"
    path.write_text(loop)
    with pytest.raises(CalibrationError, match=r"an alias refers to itself|recursive"):
        read_calibration(path)


def test_a_few_aliases_are_read(tmp_path):
    path = tmp_path / "camchain.yaml"
    pose = "[1, 0, 0, -0.1, 0, 1, 0, 0, 0, 0, 1, 0]"
    lens = LENS.format(camera="pinhole", lens="radtan")
    path.write_text(f"cam0: &lens\n{lens}cam1:\n{lens}  T_cn_cnm1: {pose}\nother: *lens\n")
    assert read_calibration(path).camera.baseline_m == pytest.approx(0.1)


@pytest.mark.parametrize(
    "text",
    [
        ".".join("a" * 190_000) + " = 1",
        "[" + ".".join("a" * 190_000) + "]",
        "x = {" + ".".join(["'a'"] * 90_000) + " = 1}",
        "x = 1\n" * 100_000,
    ],
)
def test_keys_of_many_parts_are_refused_at_once(text):
    with pytest.raises(ConfigError, match=r"dots|characters"):
        read_toml(text)


def test_lines_of_dots_in_comments_and_matrices_are_read():
    rows = ", ".join(["1.0"] * 64)
    assert read_toml(f"# {'.' * 500}\nx = [{rows}]\n")["x"] == [1.0] * 64


@pytest.mark.parametrize(
    "value", ["0x" + "f" * 50_000, "'" + "x" * 50_000 + "'", "[" + "1," * 50_000 + "]"]
)
def test_an_error_shows_the_beginning_of_a_huge_value(value):
    with pytest.raises(ConfigError) as told:
        load_toml(f"[mapper]\nsave_every_m = {value}\n", Settings)
    assert len(str(told.value)) < 300


def test_the_grid_of_a_map_is_read_by_its_header(tmp_path):
    grid, picture = tmp_path / "map.yaml", tmp_path / "map.pgm"
    grid.write_text("image: map.pgm\nresolution: 0.05\norigin: [-1.0, -2.0, 0.0]\n")
    picture.write_bytes(b"P5\n40 20\n255\n" + bytes(800))
    given = GivenAnchor(2, "n", None, (0.0, 0.0), None, 0.1)
    (one,) = on_grid([given], grid)
    assert one.position == pytest.approx((-0.975, -1.025))
