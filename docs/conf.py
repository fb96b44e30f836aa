"""The documentation site: Markdown by MyST, built offline and strictly by `make docs`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from generate import write_references

project = "Engram"
author = "the Engram authors"
extensions = ["myst_parser"]
exclude_patterns = ["generated", "_build"]
html_theme = "furo"
html_title = "Engram"
# Nothing is fetched when a page is read: the theme's fonts are the system's.
html_theme_options = {"top_of_page_buttons": []}
myst_heading_anchors = 3
suppress_warnings = ["myst.header"]

write_references(Path(__file__).parent / "generated")
