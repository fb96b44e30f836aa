"""Commands to the live process, and who waits for their answers."""

from __future__ import annotations

import itertools
import threading

_GONE = "engram live ended before it answered"


class Asking:
    """Numbers commands, and hands each answer to whoever asked. Threads may share it.

    Args:
        send: sends a command; False if no process is connected.
    """

    def __init__(self, send) -> None:
        self._send = send
        self._numbers = itertools.count(1)
        self._waiting = {}
        self._lock = threading.Lock()

    def ask(self, message, answered) -> None:
        """Sends a command; ``answered(done, text)`` is called once, on any thread."""
        number = next(self._numbers)
        with self._lock:
            self._waiting[number] = answered
        if not self._send({**message, "id": number}):
            self._answer(number, False, "engram live is not connected; it is started again")

    def wait(self, message, patience_s: float):
        """(done, text) of a command; not done if no answer came in time."""
        said = []
        heard = threading.Event()

        def answered(*answer) -> None:
            said.extend(answer)
            heard.set()

        self.ask(message, answered)
        if not heard.wait(patience_s):
            return False, f"engram live did not answer within {patience_s} s"
        return tuple(said)

    def hear(self, message) -> bool:
        """Takes a reply; False if nobody waits for it."""
        done, text = bool(message.get("ok")), str(message.get("text"))
        return self._answer(message.get("id"), done, text)

    def gone(self) -> None:
        """The process ended: it answers nobody any more."""
        for number in list(self._waiting):
            self._answer(number, False, _GONE)

    def _answer(self, number, done: bool, text: str) -> bool:
        with self._lock:
            answered = self._waiting.pop(number, None)
        if answered is not None:
            answered(done, text)
        return answered is not None
