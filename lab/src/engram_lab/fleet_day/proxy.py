"""A link that breaks: a TCP proxy that drops each connection after so many bytes."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_PIECE = 16_384
_LONGEST_S = 60.0


class CuttingProxy:
    """Forwards connections to a port of this machine.

    Args:
        port: where to.
        cut_bytes: a connection is dropped when this much has passed it, both ways together.

    Attributes:
        port: where it listens.
        cuts: connections dropped.
        passed_bytes: both ways, of all connections.
    """

    def __init__(self, port: int, cut_bytes: int) -> None:
        self._target = port
        self._cut_bytes = cut_bytes
        self._lock = threading.Lock()
        self.cuts = 0
        self.passed_bytes = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Stops listening."""
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):  # closed
            while True:
                ours, _ = self._listener.accept()
                try:
                    theirs = socket.create_connection(("127.0.0.1", self._target))
                except OSError:  # nobody there now: the caller hears it, others may come
                    ours.close()
                    continue
                left = [self._cut_bytes]
                for source, sink in ((ours, theirs), (theirs, ours)):
                    source.settimeout(_LONGEST_S)
                    threading.Thread(
                        target=self._forward, args=(source, sink, left), daemon=True
                    ).start()

    def _forward(self, source: socket.socket, sink: socket.socket, left: list[int]) -> None:
        with suppress(OSError):  # the other way was dropped
            while piece := source.recv(_PIECE):
                with self._lock:
                    part = piece[: left[0]]
                    is_cut = len(part) == left[0]
                    self.cuts += is_cut and bool(part)  # once, not once a direction
                    left[0] -= len(part)
                    self.passed_bytes += len(part)
                sink.sendall(part)
                if is_cut:
                    break
        for one in (source, sink):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


@contextmanager
def cutting(port: int, cut_bytes: int) -> Iterator[CuttingProxy]:
    """A proxy for the length of a block."""
    proxy = CuttingProxy(port, cut_bytes)
    try:
        yield proxy
    finally:
        proxy.close()
