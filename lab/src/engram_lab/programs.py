"""What the programs of the laboratory share: their command line, and figures as text and JSON."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from engram.monitor import write_whole


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured number."""

    name: str
    value: float
    unit: str = ""

    def text(self) -> str:
        """A line for people."""
        return f"  {self.name:<60}{self.value:10.3f} {self.unit}"


def command_line(about: str | None) -> argparse.ArgumentParser:
    """A parser that shows a module's docstring, and takes ``--json FILE``."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here, too")
    return parser


def report(figures: Iterable[Figure], file: Path | None, title: str = "") -> None:
    """Prints figures as they come, and adds them under the title to a JSON file if one is named."""
    if title:
        print(f"\n{title}")
    kept = []
    for one in figures:
        print(one.text(), flush=True)
        kept.append(asdict(one))
    if file is None:
        return
    known = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    with write_whole(file) as draft:
        text = json.dumps({**known, title: kept}, indent=1, ensure_ascii=False)
        draft.write_text(text + "\n", encoding="utf-8")


def numbers(text: str) -> list[int]:
    """Whole numbers joined by commas, as an argument's type."""
    return [int(part) for part in text.split(",")]
