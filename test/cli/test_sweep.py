"""`adp sweep` with real workers: interrupted, killed, on a cluster, and given what cannot be."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path as FilePath

import numpy as np
import pytest

from commands import Done, adp
from folders import CONFIG

pytest.importorskip("distributed", reason="the extra 'sweep' is not installed")

import psutil
import pyarrow.parquet as pq
import yaml

from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.core.settings.schema import flatten
from adp_path_follower.study.sweeps import cluster
from adp_path_follower.study.sweeps.cluster import noted_interrupts
from adp_path_follower.study.sweeps.folder import PartsFolder
from adp_path_follower.study.sweeps.request import read_sweep
from adp_path_follower.study.sweeps.runs import run_part

PAPER = CONFIG / "paper.yaml"
TIMEOUT = 240.0  # [s] for anything that must happen; a loaded machine is slow, not wrong
SWEEP = f"""
params: {PAPER}
settings:
  target_gain: {[round(0.1 + 0.02 * number, 2) for number in range(12)]}
  input_cost: [[1.0, 1.0], [1.0, 2.0], [2.0, 1.0]]
starts: {{random: 40, box: [0.2, 0.2, 0.3]}}
learning: frozen
duration: 1.0
rate: 50.0
"""
SMALL = f"""
params: {PAPER}
settings: {{target_gain: [0.1, 0.2]}}
starts: [[0.1, 0.1, 0.1]]
learning: frozen
duration: 1.0
"""


def command(*arguments: str | FilePath) -> list[str]:
    return [sys.executable, "-m", "adp_path_follower.cli.main", *map(str, arguments)]


def until(condition: Callable[[], object], what: str) -> None:
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end, f"not within {TIMEOUT:g} s: {what}"
        time.sleep(0.01)


def table(directory: FilePath) -> dict[str, np.ndarray]:
    """Return the runs as any Parquet reader has them."""
    found = pq.read_table(directory / "runs")
    return {name: np.array(found.column(name).to_pylist()) for name in found.column_names}


def expected(file: FilePath) -> dict[str, np.ndarray]:
    """Return the runs as one process makes them."""
    sweep = read_sweep(file)
    parts = [run_part(sweep, number) for number in range(sweep.parts)]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def assert_same(found: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> None:
    assert list(found) == list(wanted)
    for name in wanted:
        plain = wanted[name].dtype == object
        same = found[name] == wanted[name]
        assert (same if plain else same | (wanted[name] != wanted[name])).all(), name


def test_killed_worker_and_killed_command_cost_nothing_but_time(tmp_path, scheduler):
    """A worker is killed after the first part, the command itself some parts later."""
    file, out = tmp_path / "sweep.yaml", tmp_path / "out"
    file.write_text(SWEEP)
    parts = read_sweep(file).parts
    assert parts == 12

    def done() -> int:
        return len(list((out / "runs").glob("part-*.parquet")))

    running = subprocess.Popen(
        command("sweep", file, "--out", out, "--workers", "2"), stderr=subprocess.PIPE
    )
    try:
        until(lambda: done() >= 1 or running.poll() is not None, "the first part")
        children = psutil.Process(running.pid).children(recursive=True)
        workers = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
        assert len(workers) == 2
        workers[0].kill()
        at_kill = done()
        until(lambda: done() >= min(at_kill + 4, parts - 2), "parts after a worker was killed")
        assert running.poll() is None
        children = psutil.Process(running.pid).children(recursive=True)
    finally:
        running.send_signal(signal.SIGKILL)
        running.communicate()
    _, alive = psutil.wait_procs(children, timeout=TIMEOUT)
    assert not alive  # nobody works on without the command
    there = done()
    assert 1 < there < parts
    times = {part: part.stat().st_mtime_ns for part in (out / "runs").glob("part-*")}

    again = adp("sweep", str(file), "--out", str(out), "--scheduler", scheduler)
    assert again.returncode == 0, again.stderr
    assert f"{120 * there:,} of 1,440 runs are there already" in again.stderr
    assert done() == parts
    kept = [part.stat().st_mtime_ns == before for part, before in times.items()]
    assert sum(kept) == there
    found = table(out)
    assert found["run"].tolist() == list(range(1440))
    assert_same(found, expected(file))
    assert not list(out.rglob("*.unfinished"))

    # Once more: nothing is left to do, and nothing is done.
    third = adp("sweep", str(file), "--out", str(out))
    assert third.returncode == 0
    assert "0 runs" in third.stdout
    assert third.stdout.splitlines()[:-1] == again.stdout.splitlines()[:-1]
    assert third.stdout.startswith("36 settings tried for cost and effort, on 40 runs each")
    check_what_was_written(file, out, found)
    check_refusals(file, out)


def test_ctrl_c_is_answered_in_words(tmp_path):
    """A terminal sends it to every process; only the command says something."""
    file, out = tmp_path / "sweep.yaml", tmp_path / "out"
    file.write_text(SWEEP)
    running = subprocess.Popen(
        command("sweep", file, "--out", out, "--workers", "1"),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until(
        lambda: list((out / "runs").glob("part-*.parquet")) or running.poll() is not None,
        "the first part",
    )
    os.killpg(running.pid, signal.SIGINT)
    _, told = running.communicate(timeout=TIMEOUT)
    assert running.returncode == 130, told
    assert "finished work is kept; the same command resumes it" in told
    assert "Traceback" not in told


def test_an_interrupt_where_python_ignores_it_is_not_lost():
    class Dying:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with noted_interrupts() as check:
        check()
        Dying()
        with pytest.raises(KeyboardInterrupt):
            check()
    assert signal.getsignal(signal.SIGINT) is before


def check_what_was_written(file: FilePath, out: FilePath, found: dict[str, np.ndarray]) -> None:
    """The best settings are those with the least mean cost, and any node can load them."""
    sweep = read_sweep(file)
    costs = [found["cost"][found["combination"] == number].mean() for number in range(36)]
    best = load_settings(Settings, "path_follower", out / "best.yaml")
    assert best == sweep.settings(int(np.argmin(costs)))
    differing = {
        name
        for name, value in flatten(best).items()
        if value != flatten(load_settings(Settings, "path_follower", PAPER))[name]
    }
    assert differing <= {"target_gain", "input_cost"}
    (section,) = yaml.safe_load((out / "best.yaml").read_text()).values()
    assert type(section["ros__parameters"]["target_gain"]) is float
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Pareto front" in page
    assert "cost over target_gain and input_cost" in page or (
        "cost over input_cost and target_gain" in page
    )
    assert not re.search(r'(src|href)="(?!data:|#)', page.split("<script", 1)[0])


def check_refusals(file: FilePath, out: FilePath) -> None:
    """Another sweep, another version, a folder of something else."""
    file.write_text(SWEEP.replace("duration: 1.0", "duration: 3.0"))
    refused(
        adp("sweep", str(file), "--out", str(out)), "is of another sweep, which differs in duration"
    )
    file.write_text(SWEEP)
    note = out / "sweep.json"
    note.write_text(note.read_text().replace('"version": "', '"version": "9.'))
    refused(adp("sweep", str(file), "--out", str(out)), "is of adp_path_follower 9.")


def refused(done: Done | subprocess.CompletedProcess[str], words: str) -> None:
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("adp: ")


@pytest.mark.smoke
def test_a_sweep_on_a_cluster_is_the_same(tmp_path, scheduler):
    file, out = tmp_path / "sweep.yaml", tmp_path / "out"
    file.write_text(SMALL)
    done = adp("sweep", str(file), "--out", str(out), "--scheduler", scheduler)
    assert done.returncode == 0, done.stderr
    dry = adp("sweep", str(file), "--dry-run", "--scheduler", scheduler)
    assert_same(table(out), expected(file))
    assert dry.returncode == 0
    assert dry.stdout.startswith("2 runs of 1 s: 2 combinations of settings × 1 paths × 1 robots")
    assert re.search(r"about \d+ s on 1 workers of the scheduler", dry.stdout)
    assert not (out / "study.db").exists()


BAD = {
    "unknown setting": (["sweep", "unknown.yaml", "--out", "new"], "did you mean 'target_gain'?"),
    "empty range": (["sweep", "empty.yaml", "--out", "new"], "'target_gain' has an empty range"),
    "no file": (["sweep", "nowhere.yaml", "--out", "new"], "file nowhere.yaml cannot be read"),
    "no scheduler": (
        ["sweep", "small.yaml", "--out", "new", "--scheduler", "tcp://127.0.0.1:1"],
        "scheduler 'tcp://127.0.0.1:1' cannot be reached",
    ),
    "no address": (
        ["sweep", "small.yaml", "--out", "new", "--scheduler", "over there"],
        "scheduler 'over there' cannot be reached",
    ),
    "no way to connect": (
        ["sweep", "small.yaml", "--out", "new", "--scheduler", "ftp://127.0.0.1:1"],
        "scheduler 'ftp://127.0.0.1:1' cannot be reached ('ftp' is none of tcp, ws)",
    ),
    "read-only output": (
        ["sweep", "small.yaml", "--out", "/proc/sweep"],
        "output /proc/sweep cannot be written",
    ),
    "output of others": (["sweep", "small.yaml", "--out", "full"], "output full holds files of so"),
    "a file as output": (["sweep", "small.yaml", "--out", "small.yaml"], "is a file: give a dir"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> FilePath:
    found = tmp_path_factory.mktemp("bad")
    (found / "small.yaml").write_text(SMALL)
    (found / "unknown.yaml").write_text(SMALL.replace("target_gain", "target_gian"))
    (found / "empty.yaml").write_text(SMALL.replace("[0.1, 0.2]", "{low: 1.0, high: 1.0}"))
    (found / "full").mkdir()
    (found / "full" / "file").write_text("mine")
    return found


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_and_exit_code_2(folder, case, monkeypatch):
    monkeypatch.setattr(cluster, "_CONNECTING", 0.5)  # nobody comes later, either
    arguments, words = BAD[case]
    refused(adp(*arguments, cwd=folder), words)
    assert not list(folder.glob("new/runs/*"))


@pytest.mark.parametrize("name", ["best.yaml", "report.html"])
def test_results_that_cannot_be_written_are_named_at_the_end(tmp_path, scheduler, name):
    file, out = tmp_path / "small.yaml", tmp_path / "out"
    file.write_text(SMALL)
    with PartsFolder(out, read_sweep(file)):
        (out / name / "full").mkdir(parents=True)
    done = adp("sweep", str(file), "--out", str(out), "--scheduler", scheduler)
    refused(done, f"output {out / name} cannot be written: Is a directory")
    assert "target_gain" in done.stdout  # what was found is said all the same
    (out / name / "full").rmdir()
    (out / name).rmdir()
    again = adp("sweep", str(file), "--out", str(out))
    assert again.returncode == 0, again.stderr
    assert (out / name).is_file()


def test_two_commands_do_not_write_into_one_folder(tmp_path):
    import fcntl

    (tmp_path / "small.yaml").write_text(SMALL)
    out = tmp_path / "out"
    out.mkdir()
    with (out / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = adp("sweep", str(tmp_path / "small.yaml"), "--out", str(out))
    refused(done, "is being written by another adp sweep")


@pytest.mark.parametrize("name", ["sweep", "tune"])
def test_without_the_extra_the_commands_say_what_to_install(name):
    script = (
        "import importlib.util, sys\n"
        "real = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *a: "
        "None if name in ('distributed', 'optuna', 'pyarrow') else real(name, *a)\n"
        f"sys.argv = ['adp', '{name}', 'x.yaml', '--out', 'y']\n"
        "from adp_path_follower.cli.main import main\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, env={**os.environ}
    )
    refused(done, "distributed, optuna, pyarrow: pip install 'adp_path_follower[sweep]'")
