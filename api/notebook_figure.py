"""Make figures visible in notebooks and on dark pages."""

from __future__ import annotations

import io
from types import MethodType

from matplotlib.figure import Figure

from ..report.plotting.figure_to_svg import escape_texts

_DPI = 110


def shown(figure: Figure) -> Figure:
    """Return the figure with a white page, and displayed by notebooks without pyplot."""
    figure.set_facecolor("white")
    figure._repr_png_ = MethodType(_png, figure)  # type: ignore[attr-defined]
    return figure


def _png(figure: Figure) -> bytes:
    page = io.BytesIO()
    escape_texts(figure)
    figure.savefig(page, format="png", dpi=_DPI)
    return page.getvalue()
