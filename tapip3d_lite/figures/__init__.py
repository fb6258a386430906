"""Figures: pure functions of clips, tracks and scores that return figure objects, and what shows or saves them.

Flat figures are matplotlib `Figure`s made without pyplot, so nothing stays open behind the reader's back. 3D figures
are plotly with a time slider; `show_3d` pairs each with a matplotlib twin for viewers that run no JavaScript.
"""

from __future__ import annotations

import io
import json
from pathlib import Path

import plotly.graph_objects as go
from IPython import get_ipython
from IPython.display import display
from matplotlib.figure import Figure

from tapip3d_lite.figures.flat import contact_sheet, depth_map, frame_with_tracks, overview, track_colors
from tapip3d_lite.figures.scene_3d import tracks_3d, tracks_3d_static
from tapip3d_lite.files import atomic_path, check_suffix, write_text
from tapip3d_lite.validate import checked

__all__ = ["contact_sheet", "depth_map", "frame_with_tracks", "overview", "track_colors"]
__all__ += ["save_html", "save_png", "show_3d", "tracks_3d", "tracks_3d_static"]


class show_3d:
    """A 3D figure for a notebook cell: the interactive scene, then its PNG twin for viewers without JavaScript.

    They are two outputs of the cell because JupyterLab, offered both in one, shows the PNG. The scene needs no network:
    plotly installs a JupyterLab extension that draws it.

    Args:
        figure: the plotly figure.
        twin: the matplotlib figure with the same content, for static viewers such as a repository's web page.
    """

    def __init__(self, figure: go.Figure, twin: Figure) -> None:
        self.figure, self.twin = figure, twin

    def bundles(self) -> list[dict[str, object]]:
        """The two outputs, each as MIME type to content."""
        span = f" with {len(self.figure.frames)} frames" if self.figure.frames else ""
        note = f"3D scene{span}: run the cell in JupyterLab to turn it"
        scene = {"application/vnd.plotly.v1+json": json.loads(self.figure.to_json()), "text/plain": note}
        return [scene, {"image/png": png_bytes(self.twin), "text/plain": "the static twin"}]

    def _ipython_display_(self) -> None:
        for bundle in self.bundles():
            display(bundle, raw=True)


def png_bytes(figure: Figure, dpi: int = 90) -> bytes:
    """The figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


@checked
def save_png(figure: Figure, path: str | Path, dpi: int = 110) -> None:
    """Write a matplotlib figure as PNG, atomically; another suffix is a ValueError."""
    check_suffix(path, ".png")
    with atomic_path(path) as temporary:
        temporary.write_bytes(png_bytes(figure, dpi))


@checked
def save_html(figure: go.Figure, path: str | Path) -> None:
    """Write a plotly figure as one page that needs no network (plotly.js is inside, about 5 MB), atomically."""
    check_suffix(path, ".html")
    page = figure.to_html(include_plotlyjs=True, auto_play=False, validate=False, div_id="figure")
    write_text(path, page)  # the same each time, since the name of the place is not drawn at random


shell = get_ipython()
if shell is not None:  # a notebook then shows a bare `Figure` as PNG; else only figures that pyplot made
    shell.display_formatter.formatters["image/png"].for_type(Figure, png_bytes)
