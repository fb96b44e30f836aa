"""Files that can be read at one sitting."""

from __future__ import annotations

from pathlib import Path

import engram

_LONG, _TOO_LONG, _MOST_LONG = 400, 700, 16


def test_files_of_the_package_stay_short() -> None:
    root = Path(engram.__file__).parent
    files = root.rglob("*.py")
    lines = {str(file.relative_to(root)): len(file.read_text().splitlines()) for file in files}
    assert not {name: count for name, count in lines.items() if count > _TOO_LONG}
    long = {name: count for name, count in lines.items() if count > _LONG}
    assert len(long) <= _MOST_LONG, long
