"""Whether another processor computes the same bits, under an emulator.

    apt install g++-aarch64-linux-gnu qemu-user-static
    python -m engram_lab.checks.other_machine --compiler aarch64-linux-gnu-g++ \
        --emulator qemu-aarch64-static

    apt install qemu-user
    python -m engram_lab.checks.other_machine --compiler aarch64-linux-gnu-g++ \
        --emulator qemu-aarch64 --counting qemu-x86_64

Front-end, odometry and attempts are compiled without Python for both machines, and run on the first
frames of the bench's clip; a hash of all that they find is compared after each. With --counting, an
emulator of this machine, the instructions of each are counted on both, with the portable vectors.
Needs a checkout.
"""

from __future__ import annotations

import subprocess
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np

from engram import _core
from engram.frontend.blobs import _SIGMA_BORDERS_PX, SIGMA_TABLE_PX
from engram.frontend.frontend import FrontendConfig
from engram.odometry.odometry import OdometryConfig, _settings
from engram_lab.bench.data import load_bench_data
from engram_lab.programs import command_line

_CORE = Path(__file__).parents[4] / "src" / "core"
_KERNELS = [
    "extraction",
    "corners",
    "brief",
    "pyramid",
    "disparity",
    "quantise",
    "sides",
    "ordering",
    "matching",
    "pose",
    "hamming",
    "odometry",
    "tracked_window",
    "window_ba",
]
# As cmake/EngramKernels.cmake has them.
_FLAGS = [
    "-std=gnu++20",
    "-O3",
    "-Wno-psabi",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-static",
    "-DENGRAM_ISA=generic",
]


def write_inputs(folder: Path, frames: int) -> None:
    """The frames and the settings, as the program reads them."""
    pairs = load_bench_data().small[:frames]
    camera = pairs[0].camera
    parts = [
        np.array([len(pairs), camera.width, camera.height], "<i4"),
        np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m], "<f8"),
        SIGMA_TABLE_PX,
        _SIGMA_BORDERS_PX,
        *(image for pair in pairs for image in (pair.left, pair.right)),
    ]
    (folder / "frames").write_bytes(b"".join(part.tobytes() for part in parts))
    settings = _settings(OdometryConfig())
    lines = [*_assigned("settings", settings), *_assigned("settings.match", settings.match)]
    c = FrontendConfig()
    stereo = [
        c.max_disparity_px, c.min_disparity_px, c.uniqueness, c.max_residual, c.max_sigma_px,
        c.sigma_floor_px, c.sigma_scale,
    ]  # fmt: skip
    floats = ", ".join(f"static_cast<float>({value})" for value in stereo[1:])
    lines.append(
        f"const ExtractionSettings extraction{{kLandmarks, {c.octaves}, {c.fast_threshold}, "
        f"{c.cell_px}, {c.second_threshold}, static_cast<float>({c.side_difference}), "
        f"{{{stereo[0]}, {floats}}}}};"
    )
    (folder / "settings.inc").write_text("\n".join(lines) + "\n", encoding="ascii")


def _assigned(name: str, settings: object) -> list[str]:
    values = {one: getattr(settings, one) for one in dir(settings) if not one.startswith("_")}
    return [
        f"{name}.{one} = {str(value).lower() if isinstance(value, bool) else repr(value)};"
        for one, value in values.items()
        if not isinstance(value, _core.MatchSettings)
    ]


def compiled(folder: Path, compiler: str) -> Path:
    """The program for the machine of a compiler."""
    program = folder / f"program-{compiler}"
    sources = [Path(__file__).with_suffix(".cpp")]
    sources += [_CORE / "kernels" / f"{name}.cpp" for name in _KERNELS]
    includes = [f"-I{_CORE}", f"-I{folder}"]
    subprocess.run([compiler, *_FLAGS, *includes, *sources, "-o", program], check=True)
    return program


def hashes(program: Path, folder: Path, emulator: str | None) -> list[str]:
    """What the program prints."""
    run = [*([emulator] if emulator else []), str(program), str(folder / "frames")]
    return subprocess.run(run, check=True, capture_output=True, text=True).stdout.splitlines()


def instructions(program: Path, folder: Path, emulator: str) -> list[int]:
    """Of front-end, odometry and attempts, as an emulator executes them."""
    counter = folder / "counter.so"
    source = Path(__file__).with_name("other_machine_counter.c")
    subprocess.run(["cc", "-O2", "-shared", "-fPIC", source, "-o", counter], check=True)
    run = [emulator, "-plugin", str(counter), str(program), str(folder / "frames")]
    printed = subprocess.run(run, check=True, capture_output=True, text=True).stderr
    sums = [int(line) for line in printed.splitlines()]
    return [b - a for a, b in pairwise(sums)]


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("--compiler", required=True, help="for the other machine")
    parser.add_argument("--emulator", help="runs its programs here")
    parser.add_argument("--counting", help="emulator of this machine: counts instructions, too")
    parser.add_argument("--frames", type=int, default=14)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="engram-machine-") as name:
        folder = Path(name)
        write_inputs(folder, given.frames)
        ours, theirs = compiled(folder, "g++"), compiled(folder, given.compiler)
        here, there = hashes(ours, folder, None), hashes(theirs, folder, given.emulator)
        for a, b in zip(here, there, strict=True):
            print(f"{a}   there {b.rsplit(' ', 1)[1]}   {'equal' if a == b else 'DIFFERENT'}")
        if given.counting:
            own = instructions(ours, folder, given.counting)
            other = instructions(theirs, folder, given.emulator)
            for line, ran, ran_there in zip(here[1:], own, other, strict=True):
                share = ran_there / ran
                print(f"{line.split()[0]}: {ran:,} instructions, there {ran_there:,}: {share:.2f}")
            print(f"all: {sum(other) / sum(own):.2f}")
    raise SystemExit(here != there)


if __name__ == "__main__":
    main()
