"""The dispatched kernels against NumPy, on the generic path and on the machine's best one."""

import os
import subprocess
import sys

import numpy as np
import pytest

from engram import _core


def test_hamming_matrix_counts_differing_bits() -> None:
    rng = np.random.default_rng(1)
    a = rng.integers(0, 256, (37, 32), dtype=np.uint8)
    b = rng.integers(0, 256, (53, 32), dtype=np.uint8)
    expected = np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2)
    np.testing.assert_array_equal(_core.hamming_matrix(a, b), expected)


def test_descriptors_off_the_alignment_of_words_are_refused() -> None:
    data = np.zeros(3 * 32 + 1, np.uint8)
    descriptors, off = data[:-1].reshape(3, 32), data[1:].reshape(3, 32)
    assert _core.hamming_matrix(descriptors, descriptors).max() == 0
    for pair in ((off, descriptors), (descriptors, off)):
        with pytest.raises(ValueError, match="multiple of 8 bytes: pass a copy"):
            _core.hamming_matrix(*pair)


@pytest.mark.parametrize(("asked", "stands"), [("generic", True), ("v9", False)])
def test_engram_isa_is_obeyed_or_refused(asked: str, stands: bool) -> None:
    run = subprocess.run(
        [sys.executable, "-c", "from engram import _core; print(_core.isa)"],
        env={**os.environ, "ENGRAM_ISA": asked},
        capture_output=True,
        text=True,
        check=False,
    )
    if stands:
        assert run.stdout.strip() == asked
    else:
        assert run.returncode != 0
        assert "expected one of generic, v3, v4" in run.stderr
