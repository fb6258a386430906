"""Guesses: sealed before the result is seen, and scored by sign and order of size.

The cell above holds `my_guess = None` and is tagged `guess`. While it says None, the result cell below shows nothing;
`my_guess = "show me"` opens it without a guess.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from IPython.display import display

from lessons.compare import number
from lessons.verdict import Verdict

SHOW = "show me"
_FACTOR = 2.0


class Revealed:
    """A result behind its seal; shows itself as the last line of a notebook cell.

    Attributes:
        verdict: of the guess.
        then: prints, and returns what else is to be shown; called only if the seal is open.
    """

    def __init__(self, verdict: Verdict, then: Callable[[], object] | None) -> None:
        self.verdict, self.then = verdict, then

    def _ipython_display_(self) -> None:
        display(self.verdict)
        if self.then is not None and self.verdict.status != "sealed":
            shown = self.then()
            for part in shown if isinstance(shown, list | tuple) else [shown]:
                if part is not None:
                    display(part)


def reveal(
    guess: float | str | None,
    truth: float | str,
    *,
    unit: str = "",
    null: float | None = None,
    least: float = 0.02,
    choices: Sequence[str] = (),
    then: Callable[[], object] | None = None,
) -> Revealed:
    """Open a sealed result for a guess.

    Args:
        guess: the reader's number or word; None keeps the seal, `"show me"` opens it without a guess.
        truth: the measured number or word.
        unit: printed behind the numbers.
        null: the value that would mean "no effect": 0 for a difference, another number, e.g. 1, for a ratio. A guess is
            then right if it has the effect's sign, and its size within a factor of two. None: there is no effect, only
            a size, which must be right within a factor of two.
        least: effects (differences, or logarithms of ratios) up to this one count as none.
        choices: the words that may be guessed.
        then: prints, and returns figures or a list of them: what lies under the seal.
    """
    if guess is None:
        how = f'write your guess into the cell above and run both again; "{SHOW}" opens without a guess.'
        return Revealed(Verdict("sealed", how), None)
    measured = f"measured: {number(truth)} {unit}".rstrip()
    if isinstance(guess, str) and guess.strip().lower() == SHOW:
        return Revealed(Verdict("shown", f"no guess; {measured}"), then)
    if isinstance(truth, str):
        word = str(guess).strip().lower()
        if choices and word not in [choice.lower() for choice in choices]:
            return Revealed(Verdict("sealed", f"expected one of {', '.join(choices)}, got {guess!r}."), None)
        status = "passed" if word == truth.lower() else "wrong"
        return Revealed(Verdict(status, f"you said {guess}; {measured}"), then)
    try:
        mine = float(guess)
        right, why = _scored(mine, float(truth), null, least)
    except (TypeError, ValueError):
        return Revealed(Verdict("sealed", f'expected a number or "{SHOW}", got {guess!r}.'), None)
    return Revealed(Verdict("passed" if right else "wrong", f"{why}; you said {number(mine)}, {measured}"), then)


def _scored(guess: float, truth: float, null: float | None, least: float) -> tuple[bool, str]:
    if not math.isfinite(guess):
        raise ValueError
    if null is None:
        a, b, least = guess, truth, 0.0
    elif null == 0:
        a, b = guess, truth
    else:
        if guess / null <= 0:
            return False, "a ratio is positive"
        a, b = math.log(guess / null), math.log(truth / null)
    if null is not None and min(abs(a), abs(b)) <= least:
        if abs(a) <= least and abs(b) <= least:
            return True, "there is indeed no effect"
        return False, "there is no effect" if abs(b) <= least else "there is an effect"
    if a * b <= 0:
        return False, "the sign is wrong"
    share = abs(a / b)
    if 1 / _FACTOR <= share <= _FACTOR:
        return True, "sign and size are right" if null is not None else "the size is right"
    much = "large" if share > 1 else "small"
    times = share if share > 1 else 1 / share
    return False, f"{'right sign, but ' if null is not None else ''}{times:.2g} times too {much}"
