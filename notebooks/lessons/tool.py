"""What the authoring tools share: a command line that answers bad input with one line and exit code 2."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn


class ToolParser(argparse.ArgumentParser):
    """A parser of `python3 run.py NAME`."""

    def __init__(self, name: str, description: str) -> None:
        super().__init__(prog=f"run.py {name}", description=description)

    def error(self, message: str) -> NoReturn:
        """Print the message as one line and leave with exit code 2."""
        self.exit(2, f"{self.prog}: {' '.join(message.split())}\n")

    @contextmanager
    def complaints(self) -> Iterator[None]:
        """Inside, what the user can mend (ValueError, OSError) ends the program as a wrong option does."""
        try:
            yield
        except (ValueError, OSError) as error:
            self.error(str(error))
