"""Measure many simulated runs at once against the same runs one at a time, in one process.

    python bench/speed/simulation.py [--runs 1000] [--duration 30] [--json FILE]

Some of the runs are simulated alone, half of them before and half after the batch, so that a slow
moment of the machine hits both; building controllers counts in both. About three minutes on a quiet
machine, half a minute with --duration 3. The memory is that of a process of its own for each number
of runs.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path as FilePath

import numpy as np
from timing import Row, arguments, report

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.resources import config_file
from adp_path_follower.study.simulation.simulate import SimulationResult, simulate

# Parameter file, "cold" or "frozen" without learning, and what a run may take among the others, as
# a share of what it takes alone.
CASES = (
    ("default", "frozen", 1.0 / 20.0),
    ("default", "cold", 1.0 / 5.0),
    ("paper", "frozen", 1.0 / 20.0),
    ("paper", "cold", 1.0 / 5.0),
)
REGION = np.array([1.0, 1.0, np.pi / 3])  # |s|, |y| [m] and |theta| [rad] of the starts
ALONE = 6  # runs that are simulated one at a time
MEMORY_RUNS = (1, 128, 256, 512, 1024, 2048, 4096)
MEMORY_DURATION = 1.0  # [s]


def starts(count: int) -> FloatArray:
    """Return initial errors in the region where the policy is learned, shape (count, 3)."""
    return np.random.default_rng(0).uniform(-REGION, REGION, (count, 3))


def run(file: str, learning: str, errors: FloatArray, duration: float) -> SimulationResult:
    """Return the outcome of runs from some starts."""
    settings = load_settings(Settings, "path_follower", config_file(f"{file}.yaml"))
    return simulate(settings, lissajous(), errors, duration=duration, learning=learning)


def measure(file: str, learning: str, target: float, runs: int, duration: float) -> list[Row]:
    """Return the times of a batch and of some of its runs alone, and how far their costs differ."""
    errors, times = starts(runs), []
    chosen = np.linspace(0, runs - 1, min(ALONE, runs)).astype(int)
    alone: dict[int, float] = {}

    def one_at_a_time(numbers: np.ndarray) -> None:
        for number in numbers.tolist():
            begun = time.perf_counter()
            alone[number] = float(run(file, learning, errors[number], duration).cost[0])
            times.append(time.perf_counter() - begun)

    one_at_a_time(chosen[::2])
    begun = time.perf_counter()
    costs = run(file, learning, errors, duration).cost
    seconds = time.perf_counter() - begun
    one_at_a_time(chosen[1::2])
    single = float(np.median(times))
    difference = max(abs(cost / costs[number] - 1.0) for number, cost in alone.items())
    name = f"{file}, {learning}: run of {duration:g} s"
    each, speed = seconds / runs, runs * duration / seconds
    return [
        Row(f"{name}, alone", 1e3 * single, "ms", 1.0, "alone"),
        Row(f"{name}, one of {runs} at once", 1e3 * each, "ms", each / single, "alone", target),
        Row(f"{file}, {learning}: simulated, {runs} at once", speed, "s/s"),
        Row(f"{file}, {learning}: difference of J alone and at once", difference, "of J"),
    ]


def peak_memory(file: str, learning: str, runs: int) -> float:
    """Return the peak memory [MB] of a process that simulates so many runs at once."""
    command = [sys.executable, __file__, "--memory-of", file, learning, str(runs)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603
    return float(done.stdout)


def main() -> None:
    """Print the table, and write the results if asked."""
    if sys.argv[1:2] == ["--memory-of"]:
        file, learning, count = sys.argv[2:]
        run(file, learning, starts(int(count)), MEMORY_DURATION)
        # Not resource.getrusage, which begins with the peak of the process that started this one.
        status = FilePath("/proc/self/status").read_text(encoding="ascii")
        print(float(status.split("VmHWM:")[1].split()[0]) / 1024.0)
        return
    parser = arguments(__doc__)
    parser.add_argument("--runs", type=int, default=1000, help="runs at once")
    parser.add_argument("--duration", type=float, default=30.0, help="simulated time [s]")
    given: argparse.Namespace = parser.parse_args()
    rows = []
    for file, learning, target in CASES:
        rows += measure(file, learning, target, given.runs, given.duration)
        print(f"{file}, {learning} done", file=sys.stderr)
    for file, learning, _ in CASES[1::2]:
        name = f"{file}, {learning}: peak memory of a process, runs of {MEMORY_DURATION:g} s"
        rows += [
            Row(f"{name}: {count}", peak_memory(file, learning, count), "MB")
            for count in MEMORY_RUNS
        ]
    report(rows, given.json)


if __name__ == "__main__":
    main()
