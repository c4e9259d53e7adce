"""How the documentation is built: `.ci/docs`. The texts are README, pages, notebooks and docstrings; none is here."""

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import hhtjax

project = "hhtjax"
version = release = hhtjax.__version__
copyright = "the authors of hhtjax, Apache-2.0"

extensions = [
    "myst_nb", "sphinx.ext.autodoc", "sphinx.ext.viewcode", "sphinx_copybutton", "plain_text", "mathml", "pages",
]  # fmt: skip

# Sources lie where they are read on GitHub too, so that links between them hold in both places.
root_doc = "docs/index"
include_patterns = [
    "docs/**", "experiments/*/README.md", "experiments/notebooks/*.md", "experiments/notebooks/*.ipynb",
    "CHANGELOG.md", "CONTRIBUTING.md",
]  # fmt: skip
exclude_patterns = [".*", "**/.*", "**/output", "build", "dist", "**/*.egg-info", "docs/_build"]

nb_execution_mode = "off"  # notebooks are shown as they were committed
nb_merge_streams = True
nb_ipywidgets_js = {}  # nothing from the network
myst_enable_extensions = ["dollarmath", "amsmath"]
myst_heading_anchors = 3
suppress_warnings = ["mystnb.unknown_mime_type"]  # of outputs that only a running notebook can show

autodoc_typehints = "none"  # docstrings say what is what, in words
autodoc_member_order = "bysource"
default_role = "code"
add_module_names = False
smartquotes = False
highlight_language = "none"  # formulas; code says what it is
toc_object_entries_show_parents = "hide"
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

html_theme = "furo"
html_title = f"hhtjax {version}"
html_theme_options = {"source_repository": "", "top_of_page_buttons": []}
html_additional_pages = {"index": "redirect.html"}  # the root document is docs/index
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["hhtjax.css"]
html_math_renderer = "mathml"
html_show_sphinx = False
html_show_sourcelink = False
html_copy_source = False


def with_readme(_, name, source):
    """The start page is README, whose links count from the folder above."""
    if name == root_doc:
        text = (Path(__file__).parents[1] / "README.md").read_text()
        text = re.sub(r"\]\((?!https?:|docs/)", "](../", text).replace("](docs/", "](")
        source[0] = source[0].replace("(README)\n", text)


def setup(app):
    """Called by Sphinx."""
    app.connect("source-read", with_readme)
