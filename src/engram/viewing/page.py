"""A self-contained HTML page: no script, nothing fetched, every text from files escaped."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path

import cv2

from engram.monitor import write_whole
from engram.untrusted import printable
from engram.viewing.pictures import Image

# A picture of a match, 1032×384 px, comes to about 90 kB.
_JPEG_QUALITY = 82
# A browser obeys it even if a text were not escaped: no script, no font, no request.
_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


def text(value: object) -> str:
    """A value as text of a page, whatever file it is from."""
    return escape(printable(str(value)))


def paragraph(words: str, kind: str = "") -> str:
    """A paragraph."""
    return f"<p{_class(kind)}>{text(words)}</p>"


def heading(words: str, level: int = 2) -> str:
    """A heading."""
    return f"<h{level}>{text(words)}</h{level}>"


def figures(pairs: Sequence[tuple[str, str]]) -> str:
    """Names with their values, as tiles."""
    tiles = (f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>" for name, value in pairs)
    return f'<dl class="figures">{"".join(tiles)}</dl>'


def table(head: Sequence[str], rows: Sequence[Sequence[object]], caption: str) -> str:
    """A table; numbers are set to the right."""
    numbers = {
        column
        for column in range(len(head))
        if rows and all(isinstance(row[column], int | float) for row in rows)
    }

    def row(cells: Sequence[object], tag: str, scope: str = "") -> str:
        made = (
            f"<{tag}{scope}{_class('number' if at in numbers else '')}>{text(cell)}</{tag}>"
            for at, cell in enumerate(cells)
        )
        return f"<tr>{''.join(made)}</tr>"

    body = "".join(row(cells, "td") for cells in rows)
    top = row(head, "th", ' scope="col"')
    return (
        f'<div class="wide" tabindex="0" role="group" aria-label="{text(caption)}">'
        f"<table><caption>{text(caption)}</caption>"
        f"<thead>{top}</thead><tbody>{body}</tbody></table></div>"
    )


def drawing(svg: str, caption: str) -> str:
    """A drawing of `engram.viewing.drawings.as_svg`, which has its own text for the blind."""
    return (
        f'<figure><div class="wide" tabindex="0" role="group" aria-label="{text(caption)}">'
        f"{svg}</div><figcaption>{text(caption)}</figcaption></figure>"
    )


def photograph(jpeg: bytes, caption: str, details: str) -> str:
    """A picture with a sentence and its details."""
    data = base64.b64encode(jpeg).decode("ascii")
    return (
        f'<figure class="match"><img alt="{text(caption)}" src="data:image/jpeg;base64,{data}">'
        f"<figcaption><strong>{text(caption)}</strong><small>{text(details)}</small></figcaption>"
        "</figure>"
    )


def as_jpeg(picture: Image) -> bytes:
    """A picture, (h, w) or (h, w, 3) uint8 BGR, for `photograph`."""
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return encoded.tobytes()


def commands(lines: Sequence[str]) -> str:
    """Commands to copy."""
    return f"<pre>{text(chr(10).join(lines))}</pre>"


@dataclass(frozen=True, slots=True)
class Page:
    """A page.

    Attributes:
        title: its heading.
        verdict: what it found, in one sentence.
        sections: parts made by the functions of this module.
    """

    title: str
    verdict: str
    sections: Sequence[str]

    def html(self, made_by: str) -> str:
        """The page as one file."""
        style = files("engram.viewing").joinpath("data/page.css").read_text(encoding="utf-8")
        return (
            '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{text(self.title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
            f"<header>{heading(self.title, 1)}{paragraph(self.verdict, 'verdict')}</header>\n"
            f"<main>\n{chr(10).join(self.sections)}\n</main>\n"
            f"<footer>{paragraph(made_by)}</footer>\n</body>\n</html>\n"
        )

    def write(self, path: Path, made_by: str) -> None:
        """Writes the page, whole or not at all."""
        with write_whole(path) as draft:
            draft.write_text(self.html(made_by), encoding="utf-8")


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""
