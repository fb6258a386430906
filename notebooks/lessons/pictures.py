"""Pictures as a notebook shows them: sharp, with an alternative text and a caption; and the map of the method."""

from __future__ import annotations

import base64
import html
import io
import re

import numpy as np
from IPython.display import display
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from tapip3d_lite.figures import show_3d

DPI = 144
_WIDTH = 90  # CSS pixels an inch is shown at
_LOSSLESS = 60_000  # bytes above which a picture is mostly photograph, and stored with loss
_INK, _LIT, _PALE = "#30343b", "#e69f00", "#eef0f3"  # orange of the palette of Okabe and Ito

# Name, lesson, column, row of each part of the method.
_PARTS = {
    "frames\ndepth, cameras": ("00", 0, 0.5),
    "encoder\n$F$": ("01", 1, 1),
    "lift\n$P$": ("01", 1, 0),
    "world space": ("02", 2, 0),
    "feature cloud\n$\\mathcal{C}^l$": ("01", 3, 0.5),
    "neighbours\nsupport, context": ("03", 4, 0.5),
    "N2N attention": ("04", 5, 0.5),
    "token, updater\nM times": ("05", 6, 0.5),
    "tracks\nxyz, visible": ("00", 7, 0.5),
    "loss, training": ("06", 7, 1.5),
    "scores\nAJ, APD, OA": ("07", 7, -0.6),
}
_ALSO = {
    "08": ("02", "03", "04", "07"),
    "09": ("03", "04", "05", "06"),
    "10": ("00", "02"),
}  # lessons about the parts of others
_ARROWS = [(0, 1), (0, 2), (2, 3), (1, 4), (3, 4), (4, 5), (5, 6), (6, 7), (7, 8), (8, 9), (8, 10)]


class Shown:
    """A figure with words; shows itself as the last line of a notebook cell.

    Args:
        figure: a matplotlib figure, or a 3D scene with its still twin.
        alt: what it shows, for those who cannot see it.
        caption: what to look at.
    """

    def __init__(self, figure: Figure | show_3d, alt: str, caption: str) -> None:
        self.figure, self.alt, self.caption = figure, alt, caption

    def _ipython_display_(self) -> None:
        still = self.figure
        if isinstance(still, show_3d):
            display(still.bundles()[0], raw=True)
            still = still.twin
        page = f"<figure>{image(still, self.alt)}<figcaption><em>{html.escape(self.caption)}</em></figcaption></figure>"
        display({"text/html": page, "text/plain": f"[figure: {self.alt}] {self.caption}"}, raw=True)


def show(figure: Figure | show_3d, alt: str, caption: str) -> Shown:
    """A figure with an alternative text and a caption. Both are whole sentences; ValueError if one is missing."""
    for name, text in (("alt", alt), ("caption", caption)):
        if len(text.split()) < 4:
            raise ValueError(f"{name}: expected a sentence about the figure, got {text!r}")
    return Shown(figure, alt, caption)


def image(figure: Figure, alt: str) -> str:
    """A figure as an HTML image that holds its own data."""
    data = _webp(figure, lossless=True)
    data = _webp(figure, quality=88) if len(data) > _LOSSLESS else data
    width = round(figure.get_figwidth() * _WIDTH)
    code = base64.b64encode(data).decode()
    return f'<img alt="{html.escape(alt)}" width="{width}" src="data:image/webp;base64,{code}">'


def pipeline(lesson: str) -> Shown:
    """The method as a map, from RGB-D frames to tracks, with the part of a lesson (`"00"` to `"10"`) lit."""
    names = list(_PARTS)
    figure = Figure(figsize=(10.2, 2.3), layout="constrained")
    ax = figure.subplots()
    ax.set(xlim=(-0.55, 7.55), ylim=(-0.95, 1.85))
    ax.axis("off")
    line = {"arrowstyle": "-|>", "mutation_scale": 9, "color": "#8a919c", "shrinkA": 0, "shrinkB": 0}
    for a, b in _ARROWS:
        (_, x0, y0), (_, x1, y1) = _PARTS[names[a]], _PARTS[names[b]]
        way = 0.24 * np.sign(y1 - y0)
        beside = x0 - 0.2 * (way < 0)  # of the number below a part
        start, end = ((beside, y0 + way), (beside, y1 - way)) if x0 == x1 else ((x0 + 0.44, y0), (x1 - 0.44, y1))
        ax.add_patch(FancyArrowPatch(start, end, **line))
    ax.add_patch(FancyArrowPatch((6, 0.76), (4, 0.76), connectionstyle="arc3,rad=0.3", **line))
    ax.text(5, 1.42, "with the new estimate", ha="center", fontsize=8, color="#57606a")
    lit = [name for name, (number, *_) in _PARTS.items() if number in _ALSO.get(lesson, (lesson,))]
    for name, (number, x, y) in _PARTS.items():
        on = name in lit
        ax.add_patch(FancyBboxPatch((x - 0.42, y - 0.22), 0.84, 0.44, boxstyle="round,pad=0.02,rounding_size=0.08",
                                    fc=_LIT if on else _PALE, ec=_INK, lw=1.6 if on else 0.6, zorder=2))  # fmt: skip
        ax.text(x, y, name, ha="center", va="center", fontsize=8.5, color=_INK, zorder=3)
        ax.text(
            x if 0 <= y < 1.2 else x + 0.4,
            y - 0.38 if y >= 0 else y + 0.36,
            number,
            ha="center",
            va="center",
            fontsize=8,
            color="#57606a",
            zorder=3,
        )
    words = "; ".join(
        re.sub(r"\n(.*)", r" (\1)", re.sub(r"\$(?:\\mathcal\{)?(\w)[^$]*\$", r"\1", name)) for name in lit
    )
    alt = (
        "The method from left to right: frames with depth and cameras; encoder and lifting side by side; world space; "
        "feature cloud; neighbours; attention between neighbourhoods; updater, which loops back; tracks; loss; scores. "
    )
    return show(figure, f"{alt}Lit: {words}.", f"Where we are: {words}. The small numbers are the lessons.")


def _webp(figure: Figure, **options: object) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="webp", dpi=DPI, pil_kwargs={"method": 4, **options})
    return buffer.getvalue()
