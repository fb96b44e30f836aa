"""Pages of the repository outside docs/, brought into the site with their links."""

from __future__ import annotations

import os
import re
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
DOCS = Path("docs")
# Source in the repository → page of the site.
PAGES = {
    Path("CONTRIBUTING.md"): DOCS / "project/contributing.md",
    Path("CHANGELOG.md"): DOCS / "project/changes.md",
    Path("SECURITY.md"): DOCS / "project/security.md",
    **{
        path.relative_to(REPOSITORY): DOCS / "reports" / path.name
        for path in sorted((REPOSITORY / "lab/reports").glob("*.md"))
    },
}
_REPORTS = """# Reports

What was measured, how, and what failed. [Evidence and limits](../evidence.md) sums them up.

```{toctree}
:maxdepth: 1
:glob:

*
```
"""
_LINK = re.compile(r"\]\(([^)#:\s]+)(#[^)\s]*)?\)")
_CITED = re.compile(r"(?<!\[)`(lab/reports/[\w-]+\.md|CONTRIBUTING\.md|CHANGELOG\.md)`")
# MyST takes a line that begins with % for a comment, and drops it.
_PERCENT = re.compile(r"^%(?=[\s,.;:)])", re.MULTILINE)


def bring() -> None:
    """Writes the pages into the folders of docs/ that git ignores."""
    for source, page in PAGES.items():
        (REPOSITORY / page).parent.mkdir(exist_ok=True)
        text = (REPOSITORY / source).read_text(encoding="utf-8")
        (REPOSITORY / page).write_text(on_the_site(text, source, page), encoding="utf-8")
    (REPOSITORY / DOCS / "reports/index.md").write_text(_REPORTS, encoding="utf-8")


def on_the_site(text: str, source: Path, page: Path) -> str:
    """A page's text with links that hold on the site, and with citations of pages as links.

    Args:
        source: where the text lies in the repository, by which its links are relative.
        page: where it lies in docs/.
    """

    def linked(link: re.Match[str]) -> str:
        target = Path(os.path.normpath(source.parent / link[1]))
        return f"]({os.path.relpath(PAGES.get(target, target), page.parent)}{link[2] or ''})"

    def cited(citation: re.Match[str]) -> str:
        return f"[{citation[0]}]({os.path.relpath(PAGES[Path(citation[1])], page.parent)})"

    return _PERCENT.sub(r"\%", _CITED.sub(cited, _LINK.sub(linked, text)))
