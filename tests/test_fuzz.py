"""Two thousand damaged files: each is read, or refused, in bounded memory and time (`python -m tests.fuzz` makes more)."""

import sys

import pytest

from tests.fuzz import READERS, fuzz


@pytest.mark.skipif(sys.platform != "linux", reason="the memory of a child process is bounded by Linux's means")
def test_damaged_files_are_read_or_refused():
    counts, others = fuzz(range(2000), seed=0)
    assert not others, others
    assert all(count["refused"] > 10 for count in counts.values()), counts
    assert sum(count.total() for count in counts.values()) == 2000 and len(counts) == len(READERS)
