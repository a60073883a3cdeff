"""Time a sweep of 20,000 runs: whole, with a killed worker, and killed and started again.

`python bench/speed/sweep.py [SWEEP.yaml] [--folder FOLDER]`: three sweeps and a comparison, about
three times what `adp sweep SWEEP.yaml --dry-run` says; one with `--only whole`.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
import psutil
import pyarrow.parquet as pq

from adp_path_follower.study.sweeps.request import read_sweep

DEFAULT = FilePath(__file__).parents[2] / "config" / "sweeps" / "twenty_thousand.yaml"


class Command:
    """`adp sweep`, running; its memory and that of its workers is looked at every second."""

    def __init__(self, file: FilePath, out: FilePath) -> None:
        self.out = out
        self.begun = time.monotonic()
        self.most_memory = {"command": 0.0, "largest worker": 0.0, "all": 0.0}
        arguments = ["adp_path_follower.cli.main", "sweep", str(file), "--out", str(out)]
        self.process = subprocess.Popen(  # noqa: S603  # our own command
            [sys.executable, "-m", *arguments], stdout=subprocess.PIPE, text=True
        )
        threading.Thread(target=self._watch, daemon=True).start()

    def workers(self) -> list[psutil.Process]:
        """Return the worker processes."""
        children = psutil.Process(self.process.pid).children(recursive=True)
        return [child for child in children if "spawn_main" in " ".join(child.cmdline())]

    def parts(self) -> int:
        """Return the number of parts that are there."""
        return len(list((self.out / "runs").glob("part-*.parquet")))

    def until(self, condition: Callable[[], bool]) -> None:
        """Wait for an event while the command runs."""
        while not condition() and self.process.poll() is None:
            time.sleep(0.1)

    def wait(self) -> float:
        """Wait for the end; return the wall time [s]."""
        output, _ = self.process.communicate()
        if self.process.returncode == 0:
            print(output.splitlines()[-1])
        return time.monotonic() - self.begun

    def _watch(self) -> None:
        while self.process.poll() is None:
            try:
                own = psutil.Process(self.process.pid).memory_info().rss / 1e6
                others = [worker.memory_info().rss / 1e6 for worker in self.workers()]
            except psutil.NoSuchProcess:
                continue
            found = {"command": own, "largest worker": max(others, default=0.0)}
            found["all"] = own + sum(others)
            for name, value in found.items():
                self.most_memory[name] = max(self.most_memory[name], value)
            time.sleep(1.0)


def table(out: FilePath) -> dict[str, list]:
    found: dict[str, list] = pq.read_table(out / "runs").to_pydict()
    return found


def same(first: dict[str, list], second: dict[str, list]) -> bool:
    if list(first) != list(second):
        return False
    return all(
        a == b or (isinstance(a, float) and np.isnan(a) and np.isnan(b))
        for name in first
        for a, b in zip(first[name], second[name], strict=True)
    )


def whole(file: FilePath, out: FilePath, runs: int) -> None:
    """Run the sweep without trouble."""
    command = Command(file, out)
    seconds = command.wait()
    print(f"whole: {seconds:.0f} s, {runs / seconds:.1f} runs a second, memory in MB at most:")
    print("  " + ", ".join(f"{name} {value:.0f}" for name, value in command.most_memory.items()))


def with_killed_worker(file: FilePath, out: FilePath, parts: int) -> None:
    """Kill a worker half-way."""
    command = Command(file, out)
    command.until(lambda: command.parts() >= parts // 2)
    victim = command.workers()[0]
    victim.kill()
    print(f"worker {victim.pid} killed after {command.parts()} of {parts} parts")
    print(f"with a killed worker: {command.wait():.0f} s")


def killed_and_started_again(file: FilePath, out: FilePath, parts: int) -> None:
    """Kill the command itself half-way, and start it again."""
    command = Command(file, out)
    command.until(lambda: command.parts() >= parts // 2)
    command.process.send_signal(signal.SIGKILL)
    first = command.wait()
    print(f"command killed after {command.parts()} of {parts} parts, {first:.0f} s")
    print(f"killed and started again: {first + Command(file, out).wait():.0f} s in all")


def main() -> None:
    """Run the sweeps and compare their tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=FilePath, nargs="?", default=DEFAULT)
    parser.add_argument("--folder", type=FilePath, default=None)
    parser.add_argument("--only", choices=("whole",), default=None)
    options = parser.parse_args()
    folder = options.folder or FilePath(tempfile.mkdtemp(prefix="adp_sweep_"))
    sweep = read_sweep(options.file)
    runs = sweep.runs
    print(f"{runs:,} runs in {sweep.parts} parts; results in {folder}", flush=True)
    whole(options.file, folder / "whole", runs)
    if options.only:
        return
    with_killed_worker(options.file, folder / "worker", sweep.parts)
    killed_and_started_again(options.file, folder / "command", sweep.parts)
    reference = table(folder / "whole")
    each_once = reference["run"] == list(range(runs))
    print(f"each run once: {each_once}")
    for name in ("worker", "command"):
        print(f"same table after killing the {name}: {same(reference, table(folder / name))}")


if __name__ == "__main__":
    main()
