"""Events of programs that run for long, on stderr: one line each, with its time, UTC."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager

from engram.untrusted import printable


class _Line(logging.Formatter):
    converter = staticmethod(time.gmtime)

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))  # names of robots are anybody's


@contextmanager
def logging_to_stderr() -> Iterator[None]:
    """Within the block, what Engram logs is seen."""
    log, handler = logging.getLogger("engram"), logging.StreamHandler()
    handler.setFormatter(_Line("%(asctime)s %(message)s", "%Y-%m-%d %H:%M:%SZ"))
    log.addHandler(handler)
    level = log.level
    log.setLevel(logging.INFO)
    try:
        yield
    finally:
        log.setLevel(level)
        log.removeHandler(handler)
