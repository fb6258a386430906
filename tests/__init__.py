"""Tests, and commands such as `python -m tests.mix_ups`, which find the notebooks' `lessons` from any folder."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "notebooks"))
