"""How sessions are divided."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import ConfigError
from engram_lab.studies.drives import split


@given(st.integers(2, 8), st.integers(0, 40), st.integers(0, 5))
def test_every_session_is_held_out_once_and_never_trained_on_then(folds, more, seed) -> None:
    sessions = folds + more
    parts = split(sessions, folds, seed)
    assert sorted(one for part in parts for one in part.held_out) == list(range(sessions))
    for part in parts:
        assert sorted((*part.training, *part.held_out)) == list(range(sessions))
        assert list(part.training) == sorted(part.training)
    sizes = [len(part.held_out) for part in parts]
    assert max(sizes) - min(sizes) <= 1


def test_the_seed_decides() -> None:
    assert split(20, 5, 1) == split(20, 5, 1)
    assert split(20, 5, 1) != split(20, 5, 2)


def test_too_few_sessions_are_refused() -> None:
    with pytest.raises(ConfigError, match="3 sessions into 5 folds"):
        split(3, 5)
