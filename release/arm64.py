"""Cross-compiles the ARM64 wheels and runs the kernels' tests on them under an emulator.

The same tests run on this machine first and keep the bits that they print; the emulated run is
compared with them. Everything stays in build/release/arm64; no administrator is needed.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from release.pythons import pythons
from release.wheels import PROJECTS, ROOT, build_tools, run

# Debian 12's Python, so that its own package for ARM64 is there to run the wheels.
VERSION = "3.11"
COMPILER, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64-static"
PACKAGES = {
    COMPILER: "g++-aarch64-linux-gnu",
    EMULATOR: "qemu-user-static",
    "apt-get": "apt (this command fetches Debian packages)",
    "dpkg-deb": "dpkg (this command unpacks Debian packages)",
}
HOME = ROOT / "build" / "release" / "arm64"
SYSTEM, SITE, BITS = HOME / "system", HOME / "site", HOME / "bits"

# Every kernel against its plain twin, and every program that prints bits.
KERNEL_TESTS = (
    "tests/core",
    "tests/places/test_tree.py",
    "tests/frontend/test_matching.py",
    "tests/frontend/test_guided_matching.py",
    "tests/odometry/test_window_kernel.py",
    "tests/odometry/test_twin.py",
    "tests/ranking/test_instruction_sets.py",
    "tests/ranking/test_ordering_kernel.py",
)
PYTEST = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not long")


def main() -> None:
    """Runs the command; its arguments are the tests, by default those of the kernels."""
    check_tools()
    interpreter = pythons().get(VERSION)
    if interpreter is None:
        sys.exit(f"no CPython {VERSION} on the path or in pyenv: the ARM64 wheels are built by it")
    dist = ROOT / "dist"
    sources = [source for name in PROJECTS for source in dist.glob(f"{name}-*.tar.gz")]
    if len(sources) != len(PROJECTS):
        sys.exit(f"{dist} holds no source distributions; run `make wheels` first")
    tools = build_tools(VERSION, interpreter)
    wheels = [cross_compiled(source, dist, tools) for source in sources]
    python = emulated_python()
    install(wheels, tools)
    tests = sys.argv[1:] or list(KERNEL_TESTS)
    compare(python, tests)


def check_tools() -> None:
    """Ends the program if the compiler or the emulator is missing."""
    missing = [package for program, package in PACKAGES.items() if shutil.which(program) is None]
    if missing:
        sys.exit(
            "the ARM64 wheels need a cross-compiler and an emulator; on Debian 12 run\n"
            f"  apt-get install {' '.join(missing)}"
        )


def cross_compiled(source: Path, dist: Path, tools: Path) -> Path:
    """The wheel of a source distribution for ARM64, in `dist`."""
    os.environ["_PYTHON_HOST_PLATFORM"] = "linux-aarch64"
    suffix = VERSION.replace(".", "")
    os.environ["SETUPTOOLS_EXT_SUFFIX"] = f".cpython-{suffix}-aarch64-linux-gnu.so"
    toolchain = ROOT / "cmake" / "aarch64-linux-gnu.cmake"
    offline = ["--no-index", "--no-deps", "--no-build-isolation"]
    settings = ["-C", f"cmake.args=-DCMAKE_TOOLCHAIN_FILE={toolchain}"]
    with tempfile.TemporaryDirectory() as raw, tempfile.TemporaryDirectory() as repaired:
        run(tools, "-m", "pip", "wheel", "--quiet", *offline, *settings, "-w", raw, source)
        (built,) = Path(raw).glob("*.whl")
        run(tools, "-m", "auditwheel", "repair", "--wheel-dir", repaired, built)
        (wheel,) = Path(repaired).glob("*.whl")
        return Path(shutil.copy(wheel, dist))


def emulated_python() -> Path:
    """A program that is Debian's Python for ARM64, run by the emulator."""
    if not (SYSTEM / "usr" / "bin" / f"python{VERSION}").exists():
        unpack_debian()
    program = HOME / "python"
    # Its children run by this program, too, whether or not the kernel knows the emulator.
    program.write_text(
        "#!/bin/sh\n"
        f"PYTHONHOME={SYSTEM}/usr PYTHONPATH={SITE}${{PYTHONPATH:+:$PYTHONPATH}} \\\n"
        f'exec {EMULATOR} -L {SYSTEM} -0 "$0" {SYSTEM}/usr/bin/python{VERSION} "$@"\n'
    )
    program.chmod(0o755)
    return program


def unpack_debian() -> None:
    """Fetches the packages with a configuration of their own: this machine's apt stays as it is."""
    apt = HOME / "apt"
    for folder in ("lists/partial", "cache/archives/partial"):
        (apt / folder).mkdir(parents=True, exist_ok=True)
    (apt / "status").touch()
    (apt / "apt.conf").write_text(
        'APT::Architecture "arm64";\nAPT::Architectures { "arm64"; };\nAPT::Sandbox::User "";\n'
        f'Dir::State "{apt}";\nDir::State::Lists "{apt}/lists";\n'
        f'Dir::State::status "{apt}/status";\nDir::Cache "{apt}/cache";\n'
    )
    env = {**os.environ, "APT_CONFIG": str(apt / "apt.conf")}
    wanted = [f"python{VERSION}-minimal", f"libpython{VERSION}-stdlib", "libstdc++6"]
    fetch = ["install", "--yes", "--download-only", "--no-install-recommends", *wanted]
    for command in (["update"], fetch):
        subprocess.run(["apt-get", "-qq", *command], env=env, check=True)
    for package in sorted((apt / "cache" / "archives").glob("*.deb")):
        subprocess.run(["dpkg-deb", "-x", package, SYSTEM], check=True)


def install(wheels: list[Path], tools: Path) -> None:
    """Both wheels, what they need and the tests' tools, as ARM64 wheels."""
    shutil.rmtree(SITE, ignore_errors=True)
    glibc = ("2014", *(f"_2_{minor}" for minor in range(17, 37)))
    platforms = [part for one in glibc for part in ("--platform", f"manylinux{one}_aarch64")]
    run(
        tools, "-m", "pip", "install", "--quiet", "--target", SITE, "--only-binary", ":all:",
        "--python-version", VERSION, *platforms, "-c", "constraints.txt",
        *wheels, "pytest", "hypothesis",
    )  # fmt: skip


def compare(python: Path, tests: list[str]) -> None:
    """Runs the tests here, then under the emulator, where each printed bit must be the same."""
    shutil.rmtree(BITS, ignore_errors=True)
    BITS.mkdir(parents=True)
    os.environ["ENGRAM_BITS"] = str(BITS)
    run(Path(sys.executable), *PYTEST, *tests)
    kept = {path.name for path in BITS.iterdir()}
    run(python, *PYTEST, *tests)
    if not kept or {path.name for path in BITS.iterdir()} != kept:
        sys.exit("the two runs printed different programs' bits: nothing is compared")
    print(f"{len(kept)} programs print the same bits on this machine and on ARM64")


if __name__ == "__main__":
    main()
