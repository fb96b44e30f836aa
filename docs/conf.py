"""The documentation site: Markdown by MyST, built offline and strictly by `make docs`."""

import sys
import tomllib
from pathlib import Path

from sphinx.application import Sphinx
from sphinx.config import Config

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS))
from generate import write_api, write_references
from outside import bring, on_the_site

_PROJECT = tomllib.loads((DOCS.parent / "pyproject.toml").read_text())["project"]

project = "Engram"
author = "the Engram authors"
release = _PROJECT["version"]
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
]
exclude_patterns = ["generated", "_build"]
default_role = "code"
autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
maximum_signature_line_length = 80
napoleon_use_ivar = True
# A notebook that fails, or takes long, fails the build.
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True
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
write_api(DOCS / "api")
bring()


def setup(app: Sphinx) -> None:
    """Adds the repository's address: of pyproject.toml, else `-D repository=URL`."""
    app.add_config_value("repository", _PROJECT.get("urls", {}).get("Repository", ""), "html")
    app.connect("config-inited", _link_the_repository)
    app.connect("source-read", _link_outside)
    app.connect("autodoc-process-signature", _without_odd_defaults)


def _link_the_repository(_: Sphinx, config: Config) -> None:
    if config.repository:
        icon = {"name": "Repository", "url": config.repository, "html": "Repository", "class": ""}
        config.html_theme_options["footer_icons"] = [icon]


def _link_outside(_: Sphinx, name: str, text: list[str]) -> None:
    """Links of docs/ to other folders of the repository lead to their pages here."""
    page = Path("docs") / f"{name}.md"
    if (DOCS.parent / page).is_file():
        text[0] = on_the_site(text[0], page, page)


def _without_odd_defaults(
    _: Sphinx,
    _what: str,
    _name: str,
    _thing: object,
    _options: object,
    given: str | None,
    back: str,
) -> tuple[str | None, str]:
    """No signature where a default value has no Python text: the fields are listed below it."""
    return ("" if given and "<" in given else given), back
