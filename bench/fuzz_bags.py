"""Read, recover and replay thousands of damaged bags: `python bench/fuzz_bags.py [--count 2000]`.

Everything must end with success or a sentence (AdpError), within 10 s and 500 MB for each bag.
"""

from __future__ import annotations

import argparse
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from adp_path_follower.threads import use_one_blas_thread

use_one_blas_thread()
sys.path.insert(0, str(Path(__file__).parents[1] / "test" / "bags"))

import torn_bags  # noqa: E402

from adp_path_follower.bags.reader import read_run  # noqa: E402
from adp_path_follower.bags.recover import recover  # noqa: E402
from adp_path_follower.bags.replay import replay  # noqa: E402
from adp_path_follower.core.errors import AdpError  # noqa: E402


def attempt(task: Callable[[], Any]) -> tuple[Any, str]:
    """Return what a task gives, and how it ended."""
    try:
        return task(), "success"
    except AdpError:
        return None, "sentence"
    except Exception:
        traceback.print_exc()
        return None, "ESCAPED"


def read_and_replay(bag: Path) -> tuple[str, str]:
    """Return how reading and replaying a bag ended."""
    run, read = attempt(lambda: read_run(bag))
    return read, attempt(lambda: replay(run))[1] if run is not None else "not reached"


def main() -> int:
    """Print how many ended how; fail if one of them ended in any other way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="number of bags")
    parser.add_argument("--seed", type=int, default=1, help="of the first bag")
    arguments = parser.parse_args()
    outcomes: Counter[str] = Counter()
    times: list[tuple[float, int, str]] = []
    foreign = 0
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder, "run")
        torn_bags.write_run(run)
        originals = set(torn_bags.contents(run))
        files = torn_bags.variants(run)
        for seed in range(arguments.seed, arguments.seed + arguments.count):
            chance = random.Random(seed)  # noqa: S311
            kind = chance.choice(sorted(files))
            way, content = torn_bags.mutated(files[kind], chance)
            torn = torn_bags.copy_with(run, Path(folder, "torn"), content)
            if chance.random() < 0.3:
                (torn / "metadata.yaml").unlink()
            shutil.rmtree(Path(folder, "new"), ignore_errors=True)
            started = time.perf_counter()
            saved, end = attempt(lambda: recover(torn, Path(folder, "new")))  # noqa: B023
            outcomes[f"recover: {end}"] += 1
            for name, bag in (("torn", torn), *([("new", saved.bag)] if saved else [])):
                read, replayed = read_and_replay(bag)
                outcomes[f"read {name} bag: {read}"] += 1
                outcomes[f"replay {name} bag: {replayed}"] += 1
                if name == "new" and read != "success":
                    print(f"seed {seed}, {kind}, {way}: the recovered bag cannot be read")
            times.append((time.perf_counter() - started, seed, f"{kind}, {way}"))
            if saved and not set(torn_bags.contents(saved.bag)) <= originals:
                foreign += 1
                outcomes[f"bags with a changed message: {kind}, {way}"] += 1
    for outcome, count in sorted(outcomes.items()):
        print(f"{count:6d}  {outcome}")
    longest, seed, what = max(times)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    mean = sum(duration for duration, _, _ in times) / len(times)
    print(f"longest {longest:.2f} s (seed {seed}: {what}), mean {mean:.2f} s")
    print(f"memory at most {memory:.0f} MB, bags with a changed message {foreign}")
    escaped = any("ESCAPED" in outcome for outcome in outcomes)
    return int(escaped or longest > 10.0 or memory > 500.0)


if __name__ == "__main__":
    sys.exit(main())
