"""Frame ranges mean what Python's slices mean."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engram.errors import ConfigError
from engram.sequences.sequence import FrameRange

parts = st.none() | st.integers(0, 30)


@given(start=parts, stop=parts, step=st.none() | st.integers(1, 7), length=st.integers(0, 40))
def test_a_range_is_a_slice(start, stop, step, length) -> None:
    text = ":".join("" if part is None else str(part) for part in (start, stop, step))
    wanted = list(range(length))[start:stop:step]
    try:
        found = FrameRange.parse(text)
    except ConfigError:
        assert stop is not None
        assert stop <= (start or 0)
        return
    assert list(found.indices(length)) == wanted
    assert found.of(list(range(length))) == wanted
    assert FrameRange.parse(str(found)) == found


@pytest.mark.parametrize(
    "text",
    ["", "-5:", ":-1", "::-1", "::0", "a", "1:2:3:4", "1.5", "٣:", "9999999999:", "5:5", "7:3"],
)
def test_what_is_no_range_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="frames"):
        FrameRange.parse(text)


def test_a_negative_part_is_explained() -> None:
    with pytest.raises(ConfigError, match="counts from the end: not supported"):
        FrameRange.parse("-10:")
