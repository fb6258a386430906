"""What a checker, a guess or a milestone says."""

from __future__ import annotations

import html
from dataclasses import dataclass

_ICONS = {"passed": ("✓", "#1a7f37"), "wrong": ("✗", "#b42318"), "not attempted": ("○", "#57606a")}
_ICONS |= {"sealed": ("▣", "#57606a"), "shown": ("○", "#57606a")}


@dataclass(frozen=True)
class Verdict:
    """A judgement; shows itself as the last line of a notebook cell.

    Attributes:
        status: `"passed"`, `"wrong"`, `"not attempted"`, `"sealed"` or `"shown"`.
        message: in words.
        hint: for a recognised mistake, else empty.
    """

    status: str
    message: str
    hint: str = ""

    def __str__(self) -> str:
        lines = [f"{_ICONS[self.status][0]} {self.status}: {self.message}"]
        return "\n".join([*lines, f"Hint: {self.hint}"] if self.hint else lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        _, color = _ICONS[self.status]
        style = f"border-left:4px solid {color};padding:2px 10px;white-space:pre-wrap;font-family:monospace"
        return f'<div style="{style}">{html.escape(str(self))}</div>'
