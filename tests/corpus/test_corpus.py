"""Recorded inputs: at least as much is read as was promised, and nothing wrongly.

`python -m benchmarks.corpus` prints the counts; `--raise` raises the minima to what is read now.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from benchmarks.corpus.counts import RECORDINGS, Count
from benchmarks.corpus.groups import Promise, broken, list_groups, raise_promises, read_group, read_promises

MOST_BYTES = 15_000_000
"""Of all recordings: whoever clones the repository gets them."""


@pytest.mark.parametrize("group", list_groups())
def test_a_group_is_read_as_promised(group: str, record_property: Callable[[str, object], None]) -> None:
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        counts = read_group(group)
    finally:
        cv2.setNumThreads(threads)
    promises = read_promises()[group]
    assert set(counts) == set(promises)
    for way, count in counts.items():
        least = promises[way].least
        record_property("corpus", f"{group}, {way}: {count.read} of {count.possible} read, {least} promised")
    faults = [f"{way}: {fault}" for way, count in counts.items() if (fault := broken(promises[way], count))]
    assert not faults, "\n".join(faults)


def test_each_group_has_a_promise_and_the_recordings_are_few() -> None:
    assert set(read_promises()) == set(list_groups())
    assert len(list_groups()) > 30
    assert sum(path.stat().st_size for path in RECORDINGS.rglob("*") if path.is_file()) < MOST_BYTES
    assert (RECORDINGS / "SOURCES.md").exists()


def test_only_these_groups_have_known_wrong_readings() -> None:
    known = {group for group, ways in read_promises().items() if any(p.known_wrong for p in ways.values())}
    assert known <= {"magnets-45-to-50-cm", "magnets-faulty-bar", "magnets-tags", "magnets-wheel-turns"}


@pytest.mark.parametrize(
    ("count", "fault"),
    [
        (Count(10, 7, ()), ""),
        (Count(10, 8, ()), ""),
        (Count(10, 6, ()), "6 of 10 read, 7 were promised"),
        (Count(10, 9, ("0.jpg: 123",)), "1 wrong, 0 known: 0.jpg: 123"),
    ],
)
def test_a_promise_is_broken_by_one_reading_less_or_a_wrong_one(count: Count, fault: str) -> None:
    assert broken(Promise(7), count) == fault


def test_promises_are_raised_and_never_lowered(tmp_path: Path) -> None:
    minima = tmp_path / "minima.json"
    raise_promises({"a": {"alone": Count(10, 5, ("x", "y")), "turned": Count(10, 5)}}, minima)
    assert read_promises(minima) == {"a": {"alone": Promise(5, 2), "turned": Promise(5)}}
    later = {"a": {"alone": Count(10, 4, ("x",)), "turned": Count(10, 7, ("z",))}, "b": {"alone": Count(3, 3)}}
    raise_promises(later, minima)
    assert read_promises(minima) == {
        "a": {"alone": Promise(5, 1), "turned": Promise(7)},
        "b": {"alone": Promise(3)},
    }
