"""Runs the service together with a worker, and backs it up while it runs."""

from __future__ import annotations

import errno
import ipaddress
import logging
import multiprocessing
import os
import signal
import socket
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from engram.errors import ConfigError, InputError, MapError, StorageFullError, extra
from engram.files import draft_folder
from engram.fleet.centre.database import WorkListener
from engram.fleet.centre.objects import FolderObjects, sync_folder
from engram.fleet.centre.service import Centre
from engram.fleet.centre.worker import work
from engram.logs import logging_to_stderr
from engram.maps.map_files import copy_map
from engram.processes import end_with_parent
from engram.sqlite import is_full

_log = logging.getLogger(__name__)
_RESTART_S = 1.0
# Who follows the events stays for ever: an ending service waits so long for requests under way.
_GRACE_S = 5
# The worker's priority below the service's: a merge that takes a core delays no answer.
_WORKER_NICE = 5


@dataclass(frozen=True, slots=True)
class Listening:
    """Where the service listens.

    Raises:
        ConfigError: elsewhere than on this machine, without TLS.
    """

    host: str
    port: int
    certificate: Path | None = None
    key: Path | None = None
    insecure: bool = False

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise ConfigError("--tls-certificate and --tls-key go together")
        if self.certificate is None and not self.insecure and not _is_here(self.host):
            raise ConfigError(
                f"--host {self.host} can be reached from other machines, and tokens would be "
                "sent unencrypted: "
                "give --tls-certificate and --tls-key, or --insecure behind a proxy that does TLS"
            )


def serve(centre: Centre, listening: Listening, *, worker: bool = True) -> None:
    """Serves until it is stopped.

    Raises:
        MissingExtraError: the extra `centre` is not installed.
        InputError: it cannot listen there, or not with this certificate and key.
    """
    with extra("centre", "the centre needs its extra"):
        import uvicorn

        from engram.fleet.centre.application import create_app
    config = uvicorn.Config(
        create_app(centre),
        listening.host,
        listening.port,
        ssl_certfile=listening.certificate,
        ssl_keyfile=listening.key,
        log_level="warning",
        timeout_graceful_shutdown=_GRACE_S,
        server_header=False,
    )
    try:
        config.load()
    except OSError as error:  # SSL's, too
        files = f"{listening.certificate} and {listening.key}"
        raise InputError(f"TLS cannot be had with {files}: {error.strerror or error}") from error
    server = _announcing(uvicorn.Server)(config)
    supervised = _supervised_worker(centre) if worker else nullcontext()
    with _listening_at(listening) as taken, supervised:
        server.run(sockets=[taken])


def _listening_at(listening: Listening) -> socket.socket:
    """The socket at which to listen.

    Raises:
        InputError: it is taken, or not this machine's.
    """
    where = f"{listening.host}:{listening.port}"
    family = socket.AF_INET6 if ":" in listening.host else socket.AF_INET
    try:
        return socket.create_server((listening.host, listening.port), family=family, backlog=2048)
    except OSError as error:
        fact = (error.strerror or str(error)).partition(" (while")[0]
        cure = "give an address of this machine as --host and a port above 1023 as --port"
        if error.errno == errno.EADDRINUSE:
            cure = "another program, such as another centre, listens there: end it, or give --port"
        raise InputError(f"cannot listen at {where}: {fact}; {cure}") from error


def _announcing(kind: type[Any]) -> type[Any]:
    """A server that prints its address as soon as it answers."""

    class Announcing(kind):  # type: ignore[misc]
        async def startup(self, sockets: Any = None) -> None:
            await super().startup(sockets=sockets)
            if self.started:
                scheme = "https" if self.config.is_ssl else "http"
                host, port = self.config.host, sockets[0].getsockname()[1]
                print(f"engram centre at {scheme}://{host}:{port}", flush=True)

    return Announcing


def run_worker(
    folder: Path, database: str | None, objects: str | None, scheduler: str | None = None
) -> None:
    """Works until SIGTERM or Ctrl-C; Dask's workers dream where a scheduler is given."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    with (
        logging_to_stderr(),
        Centre(folder, database, objects) as centre,
        WorkListener(database, stop.wait) as listener,
    ):
        work(centre, listener.wait, stop.is_set, scheduler)


@contextmanager
def _supervised_worker(centre: Centre) -> Iterator[None]:
    """A worker in a process of its own; another one takes the place of one that dies."""
    stop = threading.Event()
    context = multiprocessing.get_context("spawn")

    def keep() -> None:
        while not stop.is_set():
            process = context.Process(target=_child_work, args=(centre.folder, *centre.addresses))
            process.start()
            while process.is_alive() and not stop.wait(_RESTART_S):
                pass
            if not stop.is_set():
                _log.error("the worker ended, exit code %s; a new one starts", process.exitcode)
            process.terminate()
            process.join()

    thread = threading.Thread(target=keep, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _child_work(folder: Path, database: str | None, objects: str | None) -> None:
    """Main function of the worker that runs with the service."""
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the service ends it
    os.nice(_WORKER_NICE)
    run_worker(folder, database, objects)


def _is_here(host: str) -> bool:
    """Whether an address is this machine's own."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def back_up(centre: Centre, target: Path) -> dict[str, int]:
    """Copies what a centre has in its folder into a new one, which `engram centre serve` opens.

    The new folder appears whole or not at all: half a backup would lose what robots forget.

    The tables come first: what maps hold beyond them is merged again and changes nothing. Packs and
    manifests never change, so that they may come last. Tables in PostgreSQL and a bucket are to be
    copied with their own tools before this, since robots forget what it holds.

    Returns:
        The revision of each map that the copy holds: robots may forget what led to it.

    Raises:
        InputError: the folder exists or cannot be made, or the tables name no map.
        StorageFullError: it does not fit there.
    """
    if target.exists():
        raise InputError(f"{target} exists already; choose another name")
    names = centre.map_names()
    if not names:
        raise InputError(
            f"{centre.folder} has no maps in its tables; if PostgreSQL has them, set "
            "ENGRAM_DATABASE"
        )
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{target} cannot hold a backup: {error.strerror}") from error
    with draft_folder(target) as folder:
        draft = folder / "copy"
        held = _copied(centre, draft, names)
        draft.rename(target)
        sync_folder(target.parent)
    for name, revision in held.items():
        centre.set_durable(name, revision, "backup")
    return held


def _copied(centre: Centre, draft: Path, names: list[str]) -> dict[str, int]:
    database, bucket = centre.addresses
    (draft / "maps").mkdir(parents=True)
    if database is None:
        _copy_tables(centre.folder / "centre.sqlite", draft / "centre.sqlite")
    held = {}
    for name in names:
        path = draft / "maps" / f"{name}.engram"
        with centre.reading(name) as store:  # of a copy, no more than what is published
            held[name] = store.revision
        copy_map(centre.map_path(name), path)
    objects = FolderObjects(draft / "objects")
    for prefix in ("packs", "manifests") if bucket is None else ():
        for key in centre.objects.keys(prefix):
            objects.put(key, centre.objects.get(key))
    return held


def _copy_tables(path: Path, copy: Path) -> None:
    try:
        with closing(sqlite3.connect(path)) as source, closing(sqlite3.connect(copy)) as target:
            source.backup(target)
    except sqlite3.Error as error:
        kind = StorageFullError if is_full(error) else MapError
        raise kind(f"the tables cannot be copied to {copy}: {error}") from error
