"""Lists of numbers as they are typed: joined by commas."""

from __future__ import annotations

from engram.errors import ConfigError


def numbers(text: str, option: str) -> tuple[int, ...]:
    """Whole numbers joined by commas, in their order.

    Raises:
        ConfigError: one is not a whole number.
    """
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(
            f"{option} {text!r}: expected whole numbers joined by commas, such as 0,3"
        ) from None
