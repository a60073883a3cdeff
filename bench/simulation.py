"""Measure many simulated runs at once against the same runs one at a time, in one process.

    python bench/simulation.py [--runs 1000] [--duration 30] [--json FILE]

Some of the runs are simulated alone, half of them before and half after the batch, so that a slow
moment of the machine hits both; building controllers counts in both. About three minutes on a quiet
machine, half a minute with --duration 3. The memory is that of a process of its own for each number
of runs.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.parameter_file import load_settings
from adp_path_follower.core.path_library import lissajous
from adp_path_follower.core.settings import Settings
from adp_path_follower.shared_files import config_file
from adp_path_follower.simulation import SimulationResult, simulate

CASES = (("default", "frozen"), ("default", "cold"), ("paper", "frozen"), ("paper", "cold"))
REGION = np.array([1.0, 1.0, np.pi / 3])  # |s|, |y| [m] and |theta| [rad] of the starts
ALONE = 6  # runs that are simulated one at a time
MEMORY_RUNS = (1, 128, 256, 512, 1024, 2048, 4096)
MEMORY_DURATION = 1.0  # [s]


@dataclass(frozen=True)
class Row:
    """What was measured of one parameter file.

    Attributes:
        file: Parameter file.
        learning: "cold", or "frozen" without learning.
        runs: How many at once.
        seconds: What they took together [s].
        alone: What one run took alone, median [s].
        ratio: How many times faster a run is among the others.
        simulated: Simulated seconds, summed over the runs, each second of wall time.
        simulated_by_cpu: The same, each second of this process's computing time.
        difference: Largest relative difference between J of a run alone and among the others.

    """

    file: str
    learning: str
    runs: int
    seconds: float
    alone: float
    ratio: float
    simulated: float
    simulated_by_cpu: float
    difference: float


def starts(count: int) -> FloatArray:
    """Return initial errors in the region where the policy is learned, shape (count, 3)."""
    return np.random.default_rng(0).uniform(-REGION, REGION, (count, 3))


def run(file: str, learning: str, errors: FloatArray, duration: float) -> SimulationResult:
    """Return the outcome of runs from some starts."""
    settings = load_settings(Settings, "path_follower", config_file(f"{file}.yaml"))
    return simulate(settings, lissajous(), errors, duration=duration, learning=learning)


def measure(file: str, learning: str, runs: int, duration: float) -> Row:
    """Return the times of a batch and of some of its runs alone."""
    errors, times = starts(runs), []
    chosen = np.linspace(0, runs - 1, min(ALONE, runs)).astype(int)
    alone: dict[int, float] = {}

    def one_at_a_time(numbers: np.ndarray) -> None:
        for number in numbers.tolist():
            begun = time.perf_counter()
            alone[number] = float(run(file, learning, errors[number], duration).cost[0])
            times.append(time.perf_counter() - begun)

    one_at_a_time(chosen[::2])
    begun, computed = time.perf_counter(), time.process_time()
    costs = run(file, learning, errors, duration).cost
    seconds, computed = time.perf_counter() - begun, time.process_time() - computed
    one_at_a_time(chosen[1::2])
    differences = [abs(cost / costs[number] - 1.0) for number, cost in alone.items()]
    single = float(np.median(times))
    return Row(
        file=file,
        learning=learning,
        runs=runs,
        seconds=seconds,
        alone=single,
        ratio=single * runs / seconds,
        simulated=runs * duration / seconds,
        simulated_by_cpu=runs * duration / computed,
        difference=max(differences),
    )


def peak_memory(file: str, learning: str, runs: int) -> float:
    """Return the peak memory [MB] of a process that simulates so many runs at once."""
    command = [sys.executable, __file__, "--memory-of", file, learning, str(runs)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603
    return float(done.stdout)


def main() -> None:
    """Print the tables, and write them if asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1000, help="runs at once")
    parser.add_argument("--duration", type=float, default=30.0, help="simulated time [s]")
    parser.add_argument("--json", type=Path, help="write the results here")
    parser.add_argument("--memory-of", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.memory_of:
        file, learning, count = arguments.memory_of
        run(file, learning, starts(int(count)), MEMORY_DURATION)
        # Not resource.getrusage, which begins with the peak of the process that started this one.
        status = Path("/proc/self/status").read_text(encoding="ascii")
        print(float(status.split("VmHWM:")[1].split()[0]) / 1024.0)
        return
    print(f"{platform.machine()}, Python {platform.python_version()}, numpy {np.__version__}")
    print(f"{arguments.runs} runs of {arguments.duration:g} s at 100 Hz along the figure eight")
    print(
        "| parameters | learning | at once | one alone | ratio | simulated s/s "
        "| by computing time | difference in J |"
    )
    print("|---" * 8 + "|")
    rows = []
    for file, learning in CASES:
        row = measure(file, learning, arguments.runs, arguments.duration)
        rows.append(row)
        print(
            f"| {file} | {learning} | {row.seconds:.1f} s | {row.alone:.2f} s | {row.ratio:.0f} | "
            f"{row.simulated:.0f} | {row.simulated_by_cpu:.0f} | {row.difference:.0e} |",
            flush=True,
        )
    print(f"\nPeak memory [MB] of a process, runs of {MEMORY_DURATION:g} s")
    print("| runs | " + " | ".join(map(str, MEMORY_RUNS)) + " |")
    print("|---" * (len(MEMORY_RUNS) + 1) + "|")
    memory = {}
    for file, learning in CASES[1::2]:
        found = [peak_memory(file, learning, count) for count in MEMORY_RUNS]
        memory[file] = dict(zip(MEMORY_RUNS, found, strict=True))
        print(f"| {file}, learning | " + " | ".join(f"{value:.0f}" for value in found) + " |")
    if arguments.json:
        content = {
            "cores": os.cpu_count(),
            "duration": arguments.duration,
            "cases": [asdict(row) for row in rows],
            "peak_memory_mb": memory,
        }
        arguments.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
