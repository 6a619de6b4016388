"""How `make docs` builds the pages: Markdown as it stands, the reference from the package."""

from __future__ import annotations

import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent

# What only the package knows: its commands, and what can be set in training.
sys.path.insert(0, str(ROOT / 'tools'))
from reference_pages import write_pages  # noqa: E402

write_pages(DOCS / 'generated')

project = 'fetch_hand_sim'
author = 'The fetch_hand_sim maintainers'
copyright = 'the fetch_hand_sim maintainers, Apache License 2.0'

extensions = [
    'myst_parser',
    'sphinx.ext.autodoc',
    'sphinx.ext.napoleon',
]
html_theme = 'furo'
html_title = project
html_static_path = ['_static']
html_css_files = ['pages.css']
exclude_patterns = ['benchmark/*/*.txt']

# GitHub shows the same files: plain Markdown, links to headings, indented blocks are command lines.
myst_heading_anchors = 4
highlight_language = 'text'

# Docstrings name code in single backticks, and attributes of dataclasses under `Attributes:`.
default_role = 'literal'
autodoc_member_order = 'bysource'
autodoc_typehints_format = 'short'
napoleon_use_ivar = True
