"""Objects: whole files under names, in a folder or in a bucket."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from engram.centre.errors import StoreError
from engram.errors import MapError, MissingExtraError, storage_full
from engram.monitor import write_whole


class Objects(Protocol):
    """Immutable objects by key. A key is written once, or again with the same content."""

    def put(self, key: str, body: bytes) -> None:
        """Stores an object, durable when it returns.

        Raises:
            StorageFullError: no space is left.
            StoreError: it cannot be stored now.
        """
        ...

    def put_file(self, key: str, path: Path) -> None:
        """Stores a file."""
        ...

    def get(self, key: str, start: int = 0, size: int | None = None) -> bytes:
        """An object, or `size` bytes of it.

        Raises:
            MapError: there is none, or it is shorter.
        """
        ...

    def size(self, key: str) -> int:
        """Bytes of an object."""
        ...

    def delete(self, key: str) -> None:
        """Removes an object; a missing one is no error."""
        ...

    def keys(self, prefix: str) -> Iterator[str]:
        """All keys that begin with a prefix and ``/``."""
        ...


class FolderObjects:
    """Objects as files of a folder. Every one is synced with its folder before `put` returns."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def put(self, key: str, body: bytes) -> None:
        """See `Objects`."""
        with self._storing(key) as draft:
            draft.write_bytes(body)

    def put_file(self, key: str, path: Path) -> None:
        """See `Objects`."""
        with self._storing(key) as draft, path.open("rb") as source, draft.open("wb") as copy:
            while piece := source.read(2**20):
                copy.write(piece)

    @contextmanager
    def _storing(self, key: str) -> Iterator[Path]:
        path = self._path(key)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with write_whole(path) as draft:
                yield draft
            sync_folder(path.parent)
        except OSError as error:
            full = storage_full(error, f"object {key}")
            raise full or StoreError(f"object {key} cannot be kept: {error.strerror}") from error

    def get(self, key: str, start: int = 0, size: int | None = None) -> bytes:
        """See `Objects`."""
        try:
            with self._path(key).open("rb") as file:
                file.seek(start)
                body = file.read() if size is None else file.read(size)
        except FileNotFoundError as error:
            raise MapError(f"object {key} is missing") from error
        if size is not None and len(body) != size:
            raise MapError(f"object {key} is shorter than {start + size} bytes")
        return body

    def size(self, key: str) -> int:
        """See `Objects`."""
        try:
            return self._path(key).stat().st_size
        except FileNotFoundError as error:
            raise MapError(f"object {key} is missing") from error

    def delete(self, key: str) -> None:
        """See `Objects`."""
        self._path(key).unlink(missing_ok=True)

    def keys(self, prefix: str) -> Iterator[str]:
        """See `Objects`."""
        for path in sorted((self._folder / prefix).rglob("*")):
            if path.is_file() and not path.name.startswith("."):
                yield path.relative_to(self._folder).as_posix()

    def _path(self, key: str) -> Path:
        return self._folder / key


class BucketObjects:
    """Objects in a bucket that speaks S3, or wherever else obstore reaches."""

    def __init__(self, url: str) -> None:
        try:
            from obstore.store import from_url
        except ImportError as error:
            raise MissingExtraError(
                "objects in a bucket need obstore: pip install 'engram-localisation[centre]'"
            ) from error
        self._store = from_url(url)

    @contextmanager
    def _errors(self, key: str) -> Iterator[None]:
        from obstore.exceptions import BaseError

        try:
            yield
        except FileNotFoundError as error:
            raise MapError(f"object {key} is missing") from error
        except BaseError as error:
            raise StoreError(f"object {key}: the bucket does not answer well: {error}") from error

    def put(self, key: str, body: bytes) -> None:
        """See `Objects`."""
        with self._errors(key):
            self._store.put(key, body)

    def put_file(self, key: str, path: Path) -> None:
        """See `Objects`."""
        with self._errors(key):
            self._store.put(key, path)

    def get(self, key: str, start: int = 0, size: int | None = None) -> bytes:
        """See `Objects`."""
        with self._errors(key):
            if size is None:
                return bytes(self._store.get(key).bytes())[start:]
            return bytes(self._store.get_range(key, start=start, length=size)) if size else b""

    def size(self, key: str) -> int:
        """See `Objects`."""
        with self._errors(key):
            return int(self._store.head(key)["size"])

    def delete(self, key: str) -> None:
        """See `Objects`."""
        with self._errors(key):
            self._store.delete(key)

    def keys(self, prefix: str) -> Iterator[str]:
        """See `Objects`."""
        with self._errors(prefix):
            for some in self._store.list(prefix):
                for one in some:
                    yield str(one["path"])


def sync_folder(folder: Path) -> None:
    """Makes names in a folder durable."""
    file = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)
