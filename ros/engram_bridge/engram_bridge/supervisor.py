"""Keeps `engram live` running and connected: starts it, watches it, starts it again."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import threading
import time

from engram_bridge.link import Link, LinkError, Ring

# Five are sent a second: without one for so long, the process hangs or is gone.
_SILENT_S = 1.0
# A process that has just started reads its map first.
_STARTING_S = 20.0
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.2, 5.0


class Supervisor:
    """Runs the live process and the link to it on a thread of its own.

    A process that dies, hangs, or cannot start is started again, at most after five seconds; the
    last belief is handed to the new one as a hint. Images go to whichever process is connected, and
    nowhere while none is.

    Args:
        command: arguments of the process, without ``--socket``; `command` may be changed for
            the next start.
        hear: called with each message, on the supervisor's thread; with ``{"is": "hello"}`` when
            a new process began, and ``{"is": "gone"}`` when it ended.
        said: called with what happened to the process, for the log.
        now: the clock, seconds.
    """

    def __init__(self, command, hear, said, now=time.monotonic) -> None:
        self.restarts = 0
        self.command = list(command)
        self._hear, self._said, self._now = hear, said, now
        self._folder = tempfile.mkdtemp(prefix="engram-")
        self._path = os.path.join(self._folder, "socket")
        self._log = os.path.join(self._folder, "log")
        memory = "/dev/shm" if os.path.isdir("/dev/shm") else self._folder
        self._ring_path = os.path.join(memory, os.path.basename(self._folder) + ".ring")
        self._lock = threading.Lock()
        self._link = self._ring = self._camera = self._belief = None
        self._process = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="engram-live", daemon=True)

    def start(self) -> None:
        """Starts the process."""
        self._thread.start()

    def close(self) -> None:
        """Ends the process, which commits what it mapped, and removes its files."""
        self._ended.set()
        self.ask({"do": "stop"})
        self._thread.join()
        if self._ring is not None:
            self._ring.remove()
        shutil.rmtree(self._folder)

    @property
    def pid(self):
        """Of the process; None while there is none."""
        return None if self._process is None else self._process.pid

    def see(self, camera, width: int, height: int) -> None:
        """Sets the calibration, as `engram.live.link` describes it, and the size of the images."""
        with self._lock:
            if self._ring is None or (self._ring.width, self._ring.height) != (width, height):
                if self._ring is not None:
                    self._ring.close()
                self._ring = Ring.create(self._ring_path, width, height)
            self._camera = camera
            self._introduce()

    def show(self, stamp_ns: int, left, right, outside=None) -> bool:
        """Hands over a pair, and what else saw the camera move: (4, 4) by name.

        False if nobody is connected.
        """
        with self._lock:
            if self._link is None or self._ring is None:
                return False
            ticket = self._ring.write(stamp_ns, left, right)
            message = {"do": "frame", "ticket": ticket, "stamp_ns": stamp_ns}
            for name, matrix in (outside or {}).items():
                message[name] = matrix.ravel().tolist()
            return self._send(message)

    def ask(self, message) -> bool:
        """Sends a command; False if no process is connected."""
        with self._lock:
            return self._link is not None and self._send(message)

    def _run(self) -> None:
        wait_s = _FIRST_WAIT_S
        while not self._ended.is_set():
            began = self._now()
            try:
                self._serve()
            except Exception as error:  # whatever happens to one process, the next one is started
                self._said(f"engram live: {error!r}")
            self._part()
            if self._ended.is_set():
                return
            self.restarts += 1
            # A process that ran for a while is not one that cannot start.
            wait_s = _FIRST_WAIT_S if self._now() - began > _LONGEST_WAIT_S else wait_s
            self._ended.wait(wait_s)
            wait_s = min(2 * wait_s, _LONGEST_WAIT_S)

    def _serve(self) -> None:
        """One life of the process."""
        arguments = [*self.command, "--once", "--socket", self._path]
        with open(self._log, "wb") as log:
            self._process = subprocess.Popen(
                arguments, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        try:
            if self._connected():
                self._listen()
        finally:
            self._finish()

    def _connected(self) -> bool:
        until = self._now() + _STARTING_S
        while self._process.poll() is None and self._now() < until:
            with contextlib.suppress(OSError):
                link = Link.connect(self._path)
                self._hear({"is": "hello"})
                with self._lock:
                    self._link = link
                    self._introduce()
                    if self._belief is not None:
                        self._send({"do": "place", **self._belief})
                return True
            if self._ended.wait(0.05):
                return False
        return False

    def _listen(self) -> None:
        heard = self._now()
        while self._now() - heard < _SILENT_S:
            try:
                messages = self._link.receive(0.1)
            except (EOFError, LinkError, OSError):
                return
            for message in messages:
                heard = self._now()
                if "node_from_live" in message:
                    keys = ("node", "node_from_live", "covariance")
                    self._belief = {key: message[key] for key in keys}
                self._hear(message)
        self._said(f"engram live said nothing for {_SILENT_S} s; it is started again")

    def _finish(self) -> None:
        """Waits for a process that was asked to stop, which commits first; kills any other."""
        patience_s = 30.0 if self._ended.is_set() else 0.0
        try:
            self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
        code = self._process.wait()
        self._process = None
        if not self._ended.is_set():
            with open(self._log, errors="replace") as log:
                self._said(f"engram live ended with {code}. {log.read().strip()[-400:]}")

    def _introduce(self) -> None:
        if self._link is not None and self._ring is not None:
            self._send({"do": "camera", "ring": self._ring.path, "camera": self._camera})

    def _send(self, message) -> bool:
        try:
            self._link.send(message)
        except OSError:  # the listener finds the broken link
            return False
        return True

    def _part(self) -> None:
        with self._lock:
            if self._link is not None:
                self._link.close()
            self._link = None
        self._hear({"is": "gone"})
