"""Option --full of the commands that write a report."""

from __future__ import annotations

import click

full_option = click.option(
    "--full",
    is_flag=True,
    help="Embed every sample in the report's charts. Default: a page of at most 1.5 MB, which "
    "shows long records as minima and maxima of short bins.",
)
