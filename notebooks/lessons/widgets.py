"""Explorers: thin shells that call a pure drawing function when a control moves."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence

import ipywidgets as widgets
from matplotlib.figure import Figure

from lessons.pictures import image

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
