"""The documentation site: Markdown by MyST, built offline and strictly by `make docs`."""

import sys
import tomllib
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.config import Config

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS))
from generate import write_references

_PROJECT = tomllib.loads((DOCS.parent / "pyproject.toml").read_text())["project"]

project = "Engram"
author = "the Engram authors"
release = _PROJECT["version"]
extensions = ["myst_parser", "sphinx_copybutton", "sphinx_design"]
exclude_patterns = ["generated", "_build"]
html_theme = "furo"
html_title = f"Engram {release}"
# Nothing is fetched when a page is read: the theme's fonts are the system's.
html_theme_options = {"top_of_page_buttons": []}
html_static_path = ["static"]
html_css_files = ["tables.css"]
html_show_copyright = False
highlight_language = "sh"  # a block without a language is what one types
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
suppress_warnings = ["myst.header"]
copybutton_prompt_text = "$ "

write_references(DOCS / "generated")


def setup(app: Sphinx) -> None:
    """Adds the repository's address: of pyproject.toml, else `-D repository=URL`."""
    app.add_config_value("repository", _PROJECT.get("urls", {}).get("Repository", ""), "html")
    app.connect("config-inited", _link_the_repository)


def _link_the_repository(_: Sphinx, config: Config) -> None:
    if config.repository:
        icon = {"name": "Repository", "url": config.repository, "html": "Repository", "class": ""}
        config.html_theme_options["footer_icons"] = [icon]
