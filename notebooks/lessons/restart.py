"""What to run again after a restart: each section of a lesson says which earlier ones it needs, by the names in its code.

`python3 run.py notebooks` writes the lines, and the tests compare them with the code. A section is a heading of the second
level with all below it; the opening is what stands above the first of them.
"""

from __future__ import annotations

import ast
import dis
import re
from types import CodeType

from lessons.teaching import Notebook

RULE = "*After a restart, run this opening first, down to the next heading; a section that needs others names them.*"
_LINE = re.compile(r"\n\n\*(?:After a restart,|Needs) [^\n]*\*")
_HEADING = re.compile(r"^## (?:(\d+)\. )?([^\n]*)", re.MULTILINE)


def sections(nb: Notebook) -> list[range]:
    """Indices of the cells of each section, the opening first."""
    heads = [i for i, cell in enumerate(nb["cells"]) if cell["cell_type"] == "markdown" and heading(cell)]
    return [range(*pair) for pair in zip([0, *heads], [*heads, len(nb["cells"])], strict=True)]


def needs(nb: Notebook) -> list[set[int]]:
    """For each section, the earlier ones (0 is the opening) that must have run: by the names it uses, and those they use."""
    cells = nb["cells"]
    return needed(
        ["\n".join(cells[i]["source"] for i in part if cells[i]["cell_type"] == "code") for part in sections(nb)]
    )


def needed(pieces: list[str]) -> list[set[int]]:
    """For each piece of code, the earlier ones that made a name which it uses, or which one of these uses."""
    made: dict[str, int] = {}
    found: list[set[int]] = []
    for number, code in enumerate(pieces):
        used, own = _names(compile(code, "<section>", "exec", ast.PyCF_ALLOW_TOP_LEVEL_AWAIT))
        direct = {made[name] for name in used if name in made}
        found.append(direct.union(*(found[other] for other in direct)))
        made |= dict.fromkeys(own, number)
    return found


def line(number: int, earlier: set[int], titles: list[re.Match[str] | None]) -> str:
    """The sentence of a section; empty where it needs nothing but the opening."""
    others = sorted(earlier - {0})
    if len(others) == number - 1 > 1:
        return "*Needs everything above.*"
    numbers = [titles[other][1] for other in others if titles[other][1]]
    parts = [f"“{titles[other][2]}”" for other in others if not titles[other][1]]
    if numbers:
        parts.append(f"section{'s' if len(numbers) > 1 else ''} {_listed(numbers)}")
    return f"*Needs {_listed(parts)}.*" if parts else ""


def with_lines(nb: Notebook) -> Notebook:
    """Write the sentences below the headings, in place of those that stand there; the opening gets the rule."""
    heads = [nb["cells"][cells[0]] for cells in sections(nb)]
    titles = [heading(cell) for cell in heads]
    for number, (cell, others) in enumerate(zip(heads, needs(nb), strict=True)):
        cell["source"] = _LINE.sub("", cell["source"])
        if number == 0:
            cell["source"] += f"\n\n{RULE}"
        elif sentence := line(number, others, titles):
            end = heading(cell).end()
            cell["source"] = f"{cell['source'][:end]}\n\n{sentence}{cell['source'][end:]}"
    return nb


def _names(code: CodeType) -> tuple[set[str], set[str]]:
    """Global names that a piece of code reads before it has made them itself, and those that it makes."""
    used: set[str] = set()
    made: set[str] = set()
    for step in dis.get_instructions(code):
        if step.opname in ("LOAD_NAME", "LOAD_GLOBAL") and step.argval not in made:
            used.add(step.argval)
        elif step.opname in ("STORE_NAME", "STORE_GLOBAL"):
            made.add(step.argval)
        elif isinstance(step.argval, CodeType):  # a function, or a loop in brackets
            used |= _names(step.argval)[0] - made
    return used, made


def heading(cell: Notebook) -> re.Match[str] | None:
    """The last heading of a section in a text cell: number or None, title."""
    return max(_HEADING.finditer(cell["source"]), key=re.Match.start, default=None)  # the code below is the last one's


def _listed(parts: list[str]) -> str:
    return " and ".join(filter(None, [", ".join(parts[:-1]), parts[-1]]))
