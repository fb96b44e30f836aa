"""Pages as browsers read them: what is fetched or run, and what people cannot read."""

from __future__ import annotations

from html.parser import HTMLParser
from itertools import pairwise

HOSTILE = "<script>alert(1)</script><img src=http://x.y/z onerror=alert(2)>\"'&"


class Read(HTMLParser):
    """What a browser would make of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data) -> None:
        self.words.append(data)

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def check_page(content: str, most_bytes: int = 1_000_000) -> Read:
    """Nothing fetched or run; language, title, headings in order, every picture described."""
    read = Read(content)
    assert len(content) < most_bytes
    assert not read.of("script")
    assert all(name != "link" for name, _ in read.tags)
    for _, attributes in read.tags:
        assert not any(name.startswith("on") for name in attributes)
        for name in ("src", "href", "xlink:href"):
            assert (attributes.get(name) or "#").startswith(("data:", "#"))
    (policy,) = [one for one in read.of("meta") if "http-equiv" in one]
    assert policy["content"].startswith("default-src 'none'")
    assert read.of("html") == [{"lang": "en"}]
    assert all(one["alt"] for one in read.of("img"))
    assert all(one["aria-label"] for one in read.of("svg"))
    levels = [int(name[1]) for name, _ in read.tags if name in {"h1", "h2", "h3"}]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    return read
