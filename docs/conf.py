"""Settings of the documentation: ``make docs`` builds it."""

import click

from semloc_logs import __version__
from semloc_logs.cli.main import COMMANDS, program

for name in COMMANDS:  # each file calls its function `command`; the pages show the names
    loaded = program.get_command(click.Context(program), name)
    assert loaded is not None
    loaded.name = name

project = "semloc_logs"
copyright = "The semloc_logs contributors, Apache-2.0"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx_click",
]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4
exclude_patterns = ["build", "**/.ipynb_checkpoints"]

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"

smartquotes = False  # two dashes are an option

html_theme = "furo"
html_title = f"semloc_logs {release}"
html_copy_source = False
