"""The table "formula → symbol → tensor → shape → file:line", written from the code so that it cannot go stale.

`python3 run.py formulas` writes it. `formulas.txt` says which function computes which formula of the paper, in which line (a piece of its text) and by which
tensors. File and line numbers are looked up here; the tests run a small tracker and compare every shape.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import FunctionType

from lessons.tool import ToolParser
from tapip3d_lite.files import atomic_path

_ROWS = Path(__file__).with_name("formulas.txt")

_HEAD = """# From formula to line of code

Every equation of the method, the tensor that holds each of its symbols, its shape, and the line where it happens.
Written by `python3 run.py formulas`; the tests compare it with the code and its shapes with a running tracker.

The letters are those of [SYMBOLS.md](SYMBOLS.md), the same as in the lessons. In shapes: B clips, T frames (T' padded to
whole half windows), S frames of a window, N tracks, N' of them in a window (n in the code's comments), N_t queried in
one frame, K neighbours, L levels, M updates, H x W pixels, h x w cells of the finest level, h_l x w_l of level l, C
feature channels, D width of a neighbourhood token, A heads, each d wide, G width of the trajectory token, U width of
the updater, V virtual tracks. Words in formulas are functions and settings of the code: Cross and Self are blocks of
attention and MLP in which tokens look at others, or at themselves; an arrow overwrites; a bar is a mean.

Sections, and equations (1) to (4), are those of the paper; N2N attention has no numbered equation there. Where the paper
and the released code differ, this kit computes what the released code does:

| | paper | released code and this kit |
|---|---|---|
| support | K tokens | K + 1 tokens, the query first |
| motion | the next estimate minus this one | this estimate minus the next, and minus the one before |
| time | concatenated to the token | added to the token |
| loss | distances over the true depth, summed | also times the focal length, and averaged; `form="paper"` leaves the focal length out |
"""


@dataclass(frozen=True)
class Symbol:
    """A letter of a formula: how it is written in the paper, the expression in the function, its shape."""

    written: str
    tensor: str
    shape: str


@dataclass(frozen=True)
class Formula:
    """One formula.

    Attributes:
        part: heading under which it stands.
        name: what it is called.
        latex: the formula.
        function: where it is computed, as a path below `tapip3d_lite`.
        marker: text that only the line of the formula has in that function.
        symbols: its letters; the tensor `return` is what the function returns.
    """

    part: str
    name: str
    latex: str
    function: str
    marker: str
    symbols: tuple[Symbol, ...]

    def code(self) -> FunctionType:
        """The function itself, without decorators."""
        return find_function(self.function)

    def line(self) -> int:
        """Number of the formula's line in its file; ValueError unless the function has exactly one such line."""
        lines, first = inspect.getsourcelines(self.code())
        found = [number for number, text in enumerate(lines, first) if self.marker in text]
        if len(found) != 1:
            raise ValueError(
                f"{self.function}: expected one line with {self.marker!r}, found {len(found)}; mend it in formulas.txt"
            )
        return found[0]

    def line_of(self, symbol: Symbol) -> int:
        """Number of the first line that mentions a tensor; ValueError where the function does not."""
        lines, first = inspect.getsourcelines(self.code())
        named = list(_expressions(lines))
        wanted = (symbol.tensor, re.split(r"[.\[]", symbol.tensor)[0])  # `near.points` may be known as `near` only
        numbers = next(filter(None, ([line for line, text in named if text == name] for name in wanted)), [])
        if not numbers:
            raise ValueError(f"{self.function}: nothing is called {symbol.tensor!r} there; mend it in formulas.txt")
        return first + (max(numbers) if symbol.tensor == "return" else min(numbers)) - 1


def formulas() -> list[Formula]:
    """All formulas, in the order of the paper.

    Raises:
        ValueError: a row of the table that cannot be read.
    """
    found, part = [], ""
    for block in _ROWS.read_text(encoding="utf-8").strip().split("\n\n")[1:]:
        if block.startswith("# "):
            part = block.removeprefix("# ")
            continue
        lines = [line.strip() for line in block.splitlines()]
        head = lines[0].split(" @ ")
        symbols = [tuple(cell.strip() for cell in line.split(" : ")) for line in lines[2:]]
        if len(head) != 3 or not symbols or any(len(cells) != 3 for cells in symbols):
            raise ValueError(
                f"formulas.txt: expected 'name @ function @ marker', a formula, 'symbol : tensor : shape' …; got {block!r}"
            )
        found.append(Formula(part, head[0], lines[1], head[1], head[2], tuple(Symbol(*cells) for cells in symbols)))
    return found


def find_function(path: str) -> FunctionType:
    """The function behind `module.Class.method` below `tapip3d_lite`; ValueError where there is none."""
    names = path.split(".")
    for count in range(len(names), 0, -1):
        try:
            found = import_module(".".join(["tapip3d_lite", *names[:count]]))
        except ModuleNotFoundError:
            continue
        for name in names[count:]:
            found = inspect.getattr_static(found, name, None)
        found = getattr(found, "fget", None) or getattr(found, "__func__", found)
        if isinstance(found, FunctionType):
            return inspect.unwrap(found)
        break
    raise ValueError(f"formulas.txt: tapip3d_lite.{path} is no function")


def formula_table(link: str = "../") -> str:
    """The whole table in Markdown.

    Args:
        link: path from the table's folder to the folder that holds `tapip3d_lite`.
    """
    root = Path(__file__).resolve().parents[2]
    lines, part = [_HEAD.rstrip()], ""
    for formula in formulas():
        if formula.part != part:
            part = formula.part
            lines += ["", f"## {part}", "", "| | symbol | tensor | shape | where |", "|---|---|---|---|---|"]
        file = Path(inspect.getsourcefile(formula.code())).resolve().relative_to(root).as_posix()
        line = formula.line()
        where = f"[{file}:{line}]({link}{file}#L{line})"
        lines.append(f"| **{formula.name}** | {_math(formula.latex)} | `{formula.function}` | | {where} |")
        for symbol in formula.symbols:
            line = formula.line_of(symbol)
            where = f"[:{line}]({link}{file}#L{line})"
            lines.append(f"| | {_math(symbol.written)} | `{symbol.tensor}` | `{symbol.shape}` | {where} |")
    return "\n".join(lines) + "\n"


def _math(latex: str) -> str:
    """A formula that Markdown leaves alone: GitHub drops the backslash before a sign, and pairs stars."""
    safe = {r"\,": r"\thinspace ", r"\ ": "~", r"\{": r"\lbrace ", r"\}": r"\rbrace ", "^*": r"^\ast"}
    for written, shown in safe.items():
        latex = latex.replace(written, shown)
    return f"${latex}$"


def _expressions(lines: list[str]) -> Iterator[tuple[int, str]]:
    """(line in the function, text) of every argument, expression and `return`."""
    for node in ast.walk(ast.parse(textwrap.dedent("".join(lines)))):
        if isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Return):
            yield node.lineno, "return"
        elif isinstance(node, ast.expr):
            yield node.lineno, ast.unparse(node)


def main(argv: Sequence[str] | None = None) -> None:
    """Write the table to `notebooks/FORMULAS.md`, or to `--out`."""
    parser = ToolParser("formulas", "Write the table of formulas from the code.")
    parser.add_argument("--out", type=Path, default=_ROWS.parents[1] / "FORMULAS.md", help="Markdown file")
    out = parser.parse_args(argv).out
    with parser.complaints(), atomic_path(out) as temporary:
        temporary.write_text(formula_table(), encoding="utf-8")
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
