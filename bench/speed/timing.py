"""Share timing in turns, the machine, and the table and file of results among benchmarks."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.core.geometry import FloatArray


@dataclass(frozen=True)
class Row:
    """One result.

    Attributes:
        what: Name of the measurement.
        value: Its value.
        unit: Unit of the value.
        ratio: Ratio to the floor or the peer, measured in the same run.
        against: Name of the floor or peer, empty without one.
        target: Highest ratio wanted, None without one.

    """

    what: str
    value: float
    unit: str = "µs"
    ratio: float | None = None
    against: str = ""
    target: float | None = None

    @property
    def text(self) -> str:
        """Return the row of a markdown table."""
        ratio = "" if self.ratio is None else f"{self.ratio:.3g} × {self.against}"
        target = "" if self.target is None else f"≤ {self.target:.3g}"
        if self.target is not None and self.ratio is not None:
            target += "" if self.ratio <= self.target else ", missed"
        return f"| {self.what} | {self.value:.4g} {self.unit} | {ratio} | {target} |"


def machine() -> dict[str, str]:
    """Return the machine and the versions that the results depend on."""
    lines = FilePath("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.machine(),
        "cores": str(os.cpu_count()),
        "load": f"{os.getloadavg()[0]:.2f}",
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def time_of(call: Callable[[], object], calls: int) -> float:
    """Return the mean processor time of a call [µs], without the machine's other work."""
    start = time.thread_time()
    for _ in range(calls):
        call()
    return 1e6 * (time.thread_time() - start) / calls


def in_turns(
    cases: Mapping[str, Callable[[], object]], rounds: int = 30, calls: int = 100
) -> dict[str, FloatArray]:
    """Return the time of each case in each round [µs], (rounds,): a slow moment hits all alike."""
    for call in cases.values():
        call()
    times = [{name: time_of(call, calls) for name, call in cases.items()} for _ in range(rounds)]
    return {name: np.array([found[name] for found in times]) for name in cases}


def ratio(times: FloatArray, floor: FloatArray) -> float:
    """Return the median ratio of times that were measured in turns."""
    return float(np.median(times / floor))


def table(rows: list[Row]) -> str:
    """Return rows as a markdown table."""
    return "\n".join(
        ["| what | measured | ratio | target |", "|---|---|---|---|", *(row.text for row in rows)]
    )


def report(rows: list[Row], file: FilePath | None) -> None:
    """Print the table; lay the results over those that a file has already."""
    print(table(rows), flush=True)
    if file is None:
        return
    found = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    found["machine"] = machine()
    kept = found.setdefault("rows", {})
    for row in rows:  # one may be measured against two peers
        kept[f"{row.what}; {row.against}"] = dataclasses.asdict(row)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(found, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def arguments(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser of the common options; end if BLAS may use several threads."""
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        sys.exit("set OPENBLAS_NUM_THREADS=1 and OMP_NUM_THREADS=1, as `make bench` does")
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--json", type=FilePath, help="lay the results over this file")
    return parser


def main() -> None:
    """Print the table of a file that the benchmarks wrote."""
    parser = argparse.ArgumentParser(description="Print the table of all benchmarks.")
    parser.add_argument("file", type=FilePath)
    found = json.loads(parser.parse_args().file.read_text(encoding="utf-8"))
    print(", ".join(f"{name} {value}" for name, value in found["machine"].items()))
    print(table([Row(**row) for row in found["rows"].values()]))


if __name__ == "__main__":
    main()
