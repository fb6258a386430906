"""Stopwatches for `python run.py bench`: what each saving is worth against a straightforward form."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "notebooks"))  # for lessons.saved_bytes, however the bench starts
