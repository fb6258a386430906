"""Measure speed and memory against straightforward forms; prints a Markdown table: `python run.py bench knn --quick`."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from typing import NoReturn

import torch

from tapip3d_lite.figures import save_png
from tapip3d_lite.files import write_text
from tests.bench.parts import PARTS
from tests.bench.report import figure, table


class Parser(argparse.ArgumentParser):
    """Bad input is one line and exit code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {message}\n")


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, got {text!r}")
    return int(text)


def main() -> None:
    """Measure the parts that the command line names."""
    parser = Parser(prog="bench", description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    parser.add_argument("parts", nargs="*", default=list(PARTS), metavar="part", help="of " + ", ".join(PARTS))
    parser.add_argument("--quick", action="store_true", help="small sizes, about a minute")
    parser.add_argument("--rounds", type=_count, help="how often each way is measured; each part has its own default")
    parser.add_argument("--threads", type=_count, help="of torch; with 1 the processor's time is measured")
    parser.add_argument("--out", help="JSON with every measurement")
    parser.add_argument("--figure", help="picture (PNG) of stages and memory")
    options = parser.parse_args()
    unknown = sorted(set(options.parts) - set(PARTS))
    if unknown:
        parser.error(f"expected parts among {', '.join(PARTS)}, got {', '.join(unknown)}")
    if options.threads:
        torch.set_num_threads(options.threads)
    given = {} if options.rounds is None else {"rounds": options.rounds}
    rows = [row for part in options.parts for row in PARTS[part](options.quick, **given)]
    print(table(rows))
    if options.out:
        write_text(options.out, json.dumps([asdict(row) for row in rows], indent=1))
        print(f"wrote {options.out}")
    if options.figure:
        save_png(figure(rows), options.figure)
        print(f"wrote {options.figure}")


if __name__ == "__main__":
    main()
