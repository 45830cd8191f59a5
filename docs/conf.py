"""Settings of the documentation site; ``make docs`` builds it."""

import sys
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "extensions")]

project = "sb3_uav"
author = "the sb3_uav contributors"
copyright = f"{author}, MIT license"
release = version = (ROOT / "sb3_uav" / "version.txt").read_text(encoding="utf-8").strip()

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton", "python_links", "repository_links"]
exclude_patterns = ["_build"]

# Markdown as on GitHub, with the same anchors; and fenced directives, which both show.
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 6
# Notebooks are stored with their outputs, which `make notebooks` writes and tests/test_docs_site.py checks.
nb_execution_mode = "off"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
python_use_unqualified_type_names = True
add_module_names = False

html_theme = "furo"
html_title = f"sb3_uav {release}"
html_static_path = ["_static"]
html_css_files = ["sb3_uav.css"]
html_show_sourcelink = False
html_copy_source = False


def setup(app: Sphinx) -> None:
    """
    :param app: Sphinx
    """
    # GitHub shows CSV as it is; Pygments does not know the name.
    app.add_lexer("csv", TextLexer)
