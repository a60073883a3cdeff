"""Recover, analyze and replay thousands of damaged bags: `python bench/endurance/fuzz_bags.py`.

Every command must end with success or one sentence (AdpError), within 10 s of computing time and
500 MB for each bag.
If a bag cannot be read as it is, its recovered copy is analyzed and replayed, too. Pictures
take most of the time of an analysis: `--pictures 1` draws them for every bag. Linux only.
"""

from __future__ import annotations

# ruff: noqa: S311  # random numbers for damage, not for secrets
import argparse
import contextlib
import io
import multiprocessing
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from types import FrameType
from typing import Any

import click

from adp_path_follower.threads import use_one_blas_thread

use_one_blas_thread()  # before anything imports numpy: hence the imports below
sys.path.insert(0, str(FilePath(__file__).resolve().parents[2] / "test" / "support"))

import torn_bags  # noqa: E402  # its folder is on the path only now
from adp_path_follower.analysis import bag_pngs  # noqa: E402  # imports numpy
from adp_path_follower.cli.main import adp  # noqa: E402  # imports numpy
from adp_path_follower.core.errors import AdpError  # noqa: E402  # imports numpy
from adp_path_follower.drawing.figure_style import STYLE  # noqa: E402  # imports numpy

MOST_TIME = 10.0  # [s] of computing
LONGEST_WAIT = 60.0  # [s] after which a command is interrupted
MOST_MEMORY = 500.0  # [MB]
STEPS = 100  # of the run: a second
GOOD = ("success", "sentence")


@dataclass(frozen=True)
class Attempt:
    """The end of one command.

    Attributes:
        seed: Seed of the damage.
        damage: Kind of file, and the damage.
        command: The command and its bag.
        end: "success", "sentence" or the kind of failure.
        time: Computing time, whatever else the machine does [s].
        memory: Most that the process held meanwhile [MB].
        detail: The sentence, or the traceback.

    """

    seed: int
    damage: str
    command: str
    end: str
    time: float
    memory: float
    detail: str = field(repr=False)


class _Hang(BaseException):
    """Interrupt a command that does not end."""


def _break_in(number: int, frame: FrameType | None) -> None:
    raise _Hang


def _reset_peak() -> None:
    FilePath("/proc/self/clear_refs").write_text("5")


def _peak() -> float:
    """Return the most memory that this process held since `_reset_peak` [MB]."""
    status = FilePath("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def run_command(arguments: list[str]) -> tuple[str, str]:
    """Return how a command ended, and its output."""
    output = io.StringIO()
    try:
        with (
            contextlib.redirect_stdout(output),
            contextlib.redirect_stderr(output),
            warnings.catch_warnings(record=True) as warned,
        ):
            warnings.simplefilter("always")
            with contextlib.suppress(SystemExit):  # 1 is no failure: commands that differ
                adp.main(arguments, standalone_mode=False)
        if warned:
            item = warned[0]
            return "WARNED", f"{item.filename}:{item.lineno}: {item.message}"
        return "success", ""
    except (AdpError, click.ClickException) as error:
        sentence = str(error)
        return "sentence" if len(sentence.splitlines()) == 1 else "SEVERAL LINES", sentence
    except _Hang:
        return "HANG", traceback.format_exc()
    except Exception:
        return "ESCAPED", traceback.format_exc()


def attempt(seed: int, damage: str, command: str, arguments: list[str]) -> Attempt:
    """Run a command; interrupt it if it does not end."""
    _reset_peak()
    signal.signal(signal.SIGALRM, _break_in)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_WAIT)
    started = time.process_time()
    end, detail = run_command(arguments)
    taken = time.process_time() - started
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    return Attempt(seed, damage, command, end, taken, _peak(), detail)


def attempts(
    run: FilePath, files: dict[str, bytes], commands: list[str], seed: int
) -> Iterator[Attempt]:
    """Yield how recover and other commands ended with one damaged bag."""
    chance = random.Random(seed)
    kind = chance.choice(sorted(files))
    way, content = torn_bags.mutated(files[kind], chance)
    damage = f"{kind}, {way}"
    with tempfile.TemporaryDirectory() as folder:
        torn = torn_bags.copy_with(run, FilePath(folder, "torn"), content)
        if chance.random() < 0.3:
            (torn / "metadata.yaml").unlink()
        new = FilePath(folder, "new")
        recovered = attempt(seed, damage, "recover", ["recover", str(torn), "--out", str(new)])
        yield recovered
        if recovered.end == "success" and not (kind in ("plain", "chunks") or _intact(new, run)):
            yield Attempt(seed, damage, "recover", "CHANGED MESSAGE", 0.0, 0.0, "")
        for command in commands:
            for bag in (torn, new):
                out = FilePath(folder, "out")
                shutil.rmtree(out, ignore_errors=True)
                options = ["--out", str(out)] if command == "analyze" else []
                found = attempt(seed, damage, command, [command, str(bag), *options])
                yield found
                if found.end != "sentence" or recovered.end != "success":
                    break


def _intact(bag: FilePath, run: FilePath) -> bool:
    """Return whether all messages of a bag are as they were recorded."""
    return set(torn_bags.contents(bag)) <= set(torn_bags.contents(run))


_worker: dict[str, Any] = {}


def _begin_worker(run: FilePath, commands: list[str], pictures: int) -> None:
    STYLE["savefig.dpi"] = 20  # what is in the pictures matters here, not how large they are
    _worker.update(run=run, files=torn_bags.variants(run), commands=commands, pictures=pictures)
    _worker.update(draw=bag_pngs.draw_bags)


def _work(seed: int) -> list[Attempt]:
    drawn = seed % _worker["pictures"] == 0
    bag_pngs.draw_bags = _worker["draw"] if drawn else lambda analyses, directory: []
    return list(attempts(_worker["run"], _worker["files"], _worker["commands"], seed))


def is_good(item: Attempt) -> bool:
    """Return whether a command ended as it should, soon and without much memory."""
    return item.end in GOOD and item.time <= MOST_TIME and item.memory <= MOST_MEMORY


def report(found: list[Attempt]) -> None:
    """Print how many commands ended in which way, and their time and memory."""
    for (command, end), count in sorted(Counter((a.command, a.end) for a in found).items()):
        print(f"{count:6d}  {command}: {end}")
    for command in sorted({item.command for item in found}):
        mine = [item for item in found if item.command == command]
        slowest = max(mine, key=lambda item: item.time)
        largest = max(mine, key=lambda item: item.memory)
        mean = sum(item.time for item in mine) / len(mine)
        print(
            f"{command}: slowest {slowest.time:.2f} s (seed {slowest.seed}: {slowest.damage}), "
            f"mean {mean:.2f} s, memory at most {largest.memory:.0f} MB (seed {largest.seed})"
        )


def main() -> int:
    """Print how many commands ended in which way; fail if one ended badly."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, help="number of bags")
    parser.add_argument("--seed", type=int, default=1, help="of the first bag")
    parser.add_argument("--workers", type=int, default=2, help="number of processes")
    parser.add_argument("--pictures", type=int, default=5, help="draw them for every n-th bag only")
    parser.add_argument("--commands", default="analyze,replay", help="beside recover")
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.count)
    found: list[Attempt] = []
    with tempfile.TemporaryDirectory() as folder:
        run = FilePath(folder, "run")
        torn_bags.write_run(run, STEPS, learner=True)
        with ProcessPoolExecutor(
            arguments.workers,
            multiprocessing.get_context("spawn"),
            initializer=_begin_worker,
            initargs=(run, arguments.commands.split(","), arguments.pictures),
        ) as pool:
            for number, results in enumerate(pool.map(_work, seeds), start=1):
                found += results
                for item in results:
                    if not is_good(item):
                        print(item, item.detail, sep="\n", flush=True)
                if number % 100 == 0:
                    print(f"{number} bags", file=sys.stderr, flush=True)
    report(found)
    return int(not all(map(is_good, found)))


if __name__ == "__main__":
    sys.exit(main())
