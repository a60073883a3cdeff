"""Kill the recorder at random moments and recover: `python bench/endurance/kills.py [--count 50]`.

Saved messages must equal the published ones, to the byte and without gaps, up to 0.5 s before the
kill.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path as FilePath

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import rclpy  # noqa: F401  # before messages, whose libraries it finds

sys.path.insert(0, str(FilePath(__file__).resolve().parents[2] / "test" / "support"))

import kills

from adp_path_follower.study.demo import own_domain

_MOST_LOST = 0.5  # [s]


def main() -> int:
    """Print each kill and the worst loss; fail if one of them is worse than it may be."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=50, help="number of kills")
    parser.add_argument("--seed", type=int, default=1, help="of the random moments")
    arguments = parser.parse_args()
    start = time.time_ns()
    outcomes: list[tuple[kills.Kill, kills.Outcome]] = []
    print("kill  packed  split  after [s]  messages  lost [s]")
    with own_domain() as domain, kills.published(domain, start):
        for index, kill in enumerate(kills.random_kills(arguments.count, arguments.seed)):
            with tempfile.TemporaryDirectory() as folder:
                outcome = kills.kill_and_recover(kill, start, domain, FilePath(folder))
            outcomes.append((kill, outcome))
            print(
                f"{index:4d}  {kill.compression:>6}  {'yes' if kill.max_duration else 'no':>5}  "
                f"{kill.after:9.2f}  {outcome.messages:8d}  {outcome.lost:8.3f}",
                *outcome.problems[:3],
                flush=True,
            )
    for compression in ("none", "zstd"):
        lost = sorted(o.lost for kill, o in outcomes if kill.compression == compression)
        if lost:
            print(
                f"{compression}: {len(lost)} kills, lost median {lost[len(lost) // 2]:.3f} s, "
                f"most {lost[-1]:.3f} s"
            )
    print(f"{sum(outcome.messages for _, outcome in outcomes)} messages compared")
    return int(any(outcome.lost > _MOST_LOST or outcome.problems for _, outcome in outcomes))


if __name__ == "__main__":
    sys.exit(main())
