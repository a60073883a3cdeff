"""A control step keeps no memory that grows, and the policy takes nothing large."""

import json
import subprocess
import sys

import allocations
import pytest


def measured(kind, **values):
    """Return what a process without other threads finds."""
    done = subprocess.run(
        [sys.executable, allocations.__file__, kind, json.dumps(values)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_no_line_of_the_policy_takes_more_than_4_kb():
    found = measured("lines", learning=False)
    assert len(found) > 100
    assert max(found.values()) > 2000  # the basis: four rows of 80 numbers
    assert {place: size for place, size in found.items() if size > 4096} == {}


@pytest.mark.parametrize("values", [{}, {"learning": False}, {"scheduling": "path_state"}])
def test_memory_does_not_grow_with_time(values):
    before, after = measured("growth", **values)
    assert after - before < 800 * 16  # less than a float, and its place in a list, for each step
