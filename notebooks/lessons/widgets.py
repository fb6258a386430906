"""Explorers: thin shells that call a pure drawing function when a control moves."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Sequence

import cv2
import ipywidgets as widgets
import numpy as np
from matplotlib.figure import Figure

from lessons.pictures import image
from tapip3d_lite.clip import Clip

Control = tuple[int, int] | tuple[float, float] | Sequence[str]


def explore(draw: Callable[..., Figure], *, alt: str = "The figure above.", **controls: Control) -> widgets.VBox:
    """Sliders and menus over a pure function `draw(**values) -> Figure`.

    Args:
        draw: returns a matplotlib figure; the notebook shows one static result of it above the explorer.
        alt: what the figure shows, in a sentence.
        controls: argument name to (low, high) for a slider (whole numbers, or floats in 20 steps), or to a list of
            strings for a menu. The first value, or the middle of the range, is shown first.

    Returns:
        The controls above the figure. A `ValueError` of `draw` is shown instead of the figure.
    """
    boxes = {name: _control(name, values) for name, values in controls.items()}
    # No Output: programs that run notebooks (nbclient) may wait long for messages that Outputs send.
    picture, refusal = widgets.HTML(layout={"align_self": "flex-start"}), widgets.HTML()

    def redraw(_change: object = None) -> None:
        try:
            values = {name: box.value for name, box in boxes.items()}
            setting = ", ".join(f"{name} {value}" for name, value in values.items())
            picture.value = image(draw(**values), f"{alt} Shown with {setting}.")
            refusal.value = ""
        except ValueError as error:
            refusal.value = html.escape(str(error))
        picture.layout.display = "none" if refusal.value else None

    for box in boxes.values():
        box.observe(redraw, names="value")
    redraw()
    return widgets.VBox([widgets.HBox(list(boxes.values()), layout={"flex_flow": "row wrap"}), picture, refusal])


def _control(name: str, values: Control) -> widgets.Widget:
    if all(isinstance(v, str) for v in values):
        return widgets.Dropdown(options=list(values), description=name)
    low, high = values
    if isinstance(low, int) and isinstance(high, int):
        middle = (low + high) // 2
        return widgets.IntSlider(middle, low, high, description=name, continuous_update=False)
    middle, step = (low + high) / 2, (high - low) / 20
    return widgets.FloatSlider(middle, min=low, max=high, step=step, description=name, continuous_update=False)


class PointPicker(widgets.VBox):
    """A frame on which a click picks a point, and a slider over the frames.

    A click on the picture writes its place into the text box below, which may be typed into as well; the browser needs
    no extension for it. `pixels` is what `queries_from_pixels` takes.

    Args:
        clip: T frames.
        width: of the picture on the screen, in pixels.
    """

    def __init__(self, clip: Clip, width: int = 480) -> None:
        self.clip, self.width, self._shown = clip, width, widgets.HTML()
        self.frame = widgets.IntSlider(0, 0, len(clip) - 1, description="frame", continuous_update=False)
        self.text = widgets.Text(description="t, u, v; …", layout={"width": f"{width}px"}, continuous_update=True)
        self.text.add_class(f"pick-{id(self)}")
        for box in (self.frame, self.text):
            box.observe(lambda _: self.redraw(), names="value")
        self.redraw()
        super().__init__([self.frame, self._shown, self.text])

    @property
    def pixels(self) -> np.ndarray:
        """(N, 3) rows (t, u, v) of the points picked; text that is none is a ValueError."""
        rows = [row.replace(",", " ").split() for row in self.text.value.split(";") if row.strip()]
        try:
            return np.array(rows, np.float32).reshape(-1, 3)
        except ValueError:
            raise ValueError(f"pixels: expected t, u, v; t, u, v; … got {self.text.value!r}") from None

    def redraw(self) -> None:
        """The frame with the points picked on it, those without depth crossed out, and what a click does."""
        try:
            pixels, note = self.pixels, ""
        except ValueError as error:  # half typed
            pixels, note = np.zeros((0, 3)), html.escape(str(error))
        t, (height, wide) = self.frame.value, self.clip.size
        scale = self.width / wide
        png = base64.b64encode(cv2.imencode(".png", self.clip.video[t][..., ::-1])[1]).decode()
        marks = ""
        for _, u, v in pixels[pixels[:, 0] == t]:
            inside = 0 <= round(float(u)) < wide and 0 <= round(float(v)) < height
            known = inside and self.clip.depths[t, round(float(v)), round(float(u))] > 0
            style = f"position:absolute;left:{(u + 0.5) * scale - 7:.1f}px;top:{(v + 0.5) * scale - 9:.1f}px"
            marks += f'<b style="{style};color:#d1495b;line-height:18px">{"●" if known else "✕"}</b>'
        click = (
            f"const b=document.querySelector('.pick-{id(self)} input'),r=this.getBoundingClientRect();"
            f"const u=(event.clientX-r.left)/r.width*{wide}-0.5,v=(event.clientY-r.top)/r.height*{height}-0.5;"
            f"b.value+=(b.value.trim()?'; ':'')+[{t},u.toFixed(1),v.toFixed(1)].join(', ');"
            "b.dispatchEvent(new Event('input',{bubbles:true}))"
        )
        self._shown.value = (
            f'<div style="position:relative;width:{self.width}px"><img alt="Frame {t}; a click picks a point." '
            f'style="width:100%;image-rendering:pixelated;cursor:crosshair" src="data:image/png;base64,{png}" '
            f'onclick="{click}">{marks}</div>{note}'
        )
