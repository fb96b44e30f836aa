"""What keeps the bridge from working, in words, for the status."""

from __future__ import annotations

import threading
import time

# A trouble that does not last is said for so long, and logged once in that time.
_SAID_S = 5.0
_WAITED_S = 1.0


class Troubles:
    """Collects troubles by subject, and knows which inputs do not come. Threads may share it.

    Args:
        log: a logger; each trouble is a warning.
        now: the clock, seconds.
    """

    def __init__(self, log, now=time.monotonic) -> None:
        self._log, self._now = log, now
        self._lock = threading.Lock()
        # Text, and until when it holds.
        self._texts = {}
        self._topics = [None, None]
        self._images, self._infos = [0, 0], [0, 0]
        self._pairs = 0
        self._since_s = now()

    def expect(self, side: int, images: str, infos: str) -> None:
        """Names the topics of a side, 0 left and 1 right; counts begin anew."""
        self._topics[side] = images, infos
        self._images, self._infos, self._pairs = [0, 0], [0, 0], 0
        self._since_s = self._now()

    def saw_image(self, side: int) -> None:
        """An image came."""
        self._images[side] += 1

    def saw_info(self, side: int) -> None:
        """A camera_info came."""
        self._infos[side] += 1

    def saw_pair(self) -> None:
        """Two images were a pair."""
        self._pairs += 1

    def add(self, subject: str, text: str, lasting: bool = False) -> None:
        """Says a trouble for a while, or until it is forgotten."""
        now = self._now()
        with self._lock:
            old = self._texts.get(subject)
            until_s = float("inf") if lasting else now + _SAID_S
            self._texts[subject] = text, until_s
        if old is None or old[1] < now or old[0] != text:
            self._log.warning(text)

    def forget(self, subject: str) -> None:
        """The trouble is over."""
        with self._lock:
            self._texts.pop(subject, None)

    def text(self, waiting: bool) -> str:
        """All troubles; with those of inputs that do not come, if they are waited for."""
        now = self._now()
        with self._lock:
            said = [text for text, until_s in self._texts.values() if until_s >= now]
        if waiting and not self._pairs and now - self._since_s > _WAITED_S:
            said += self._missing()
        return "; ".join(said)

    def _missing(self):
        """Which inputs never came."""
        said = []
        for side, topics in enumerate(self._topics):
            for topic, count in zip(topics or (), (self._images[side], self._infos[side])):
                if not count:
                    said.append(f"nothing came on {topic} yet")
        if not said:
            left, right = self._images
            said.append(
                f"{left} left and {right} right images, and none of them synchronised: see "
                "pair_tolerance_ms"
            )
        return said
