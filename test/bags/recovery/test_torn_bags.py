"""Bags torn at any moment and at any byte, and bags that are damaged at random."""

from __future__ import annotations

# ruff: noqa: S311  # random numbers for damage, not for secrets
import dataclasses
import math
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path as FilePath
from typing import Any

import pytest
from mcap.opcode import Opcode

import torn_bags
from adp_path_follower.analysis.bag_analysis import analyse_bag
from adp_path_follower.analysis.bag_pngs import draw_bags
from adp_path_follower.bags.reader import read_run
from adp_path_follower.bags.recovery.recover import recover
from adp_path_follower.bags.writer import BagWriter
from adp_path_follower.core.errors import AdpError, FileError
from adp_path_follower.study.replay.replay import replay
from folders import ROOT

KIND = "std_msgs/msg/Float64MultiArray"


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> FilePath:
    """Return the bag of a short run; do not change it."""
    bag = tmp_path_factory.mktemp("run") / "run"
    torn_bags.write_run(bag, steps=7, profiles=())  # libraries take their time with YAML
    return bag


@pytest.fixture(scope="module")
def files(run) -> dict[str, bytes]:
    """Return its file as several recorders would write it."""
    return torn_bags.variants(run)


def _payload(index: int) -> bytes:
    """Return a serialised array that differs from all others."""
    return index.to_bytes(8, "little") + random.Random(index).randbytes(index % 700)


def _record_until_killed(directory: FilePath, flushed: Connection) -> None:
    """Write and flush as the recorder does, and tell what was flushed."""
    writer = BagWriter(directory)
    topics = [writer.add_topic(f"/topic_{number}", KIND) for number in range(3)]
    index = 0
    while True:
        for _ in range(random.randrange(1, 60)):
            writer.write(topics[index % 3], _payload(index), 1000 + index, 7 * index)
            index += 1
        writer.flush()
        flushed.send(index)


def test_what_was_flushed_survives_kill_9(tmp_path):
    chance = random.Random(9)
    processes = multiprocessing.get_context("fork")  # no time goes into imports
    saved_counts = []
    for attempt in range(20):
        bag = tmp_path / f"bag_{attempt}"
        receiver, sender = processes.Pipe(duplex=False)
        process = processes.Process(target=_record_until_killed, args=(bag, sender))
        process.start()
        sender.close()
        if attempt:  # the first one is killed at its very start
            assert receiver.poll(20.0)
            time.sleep(chance.uniform(0.0, 0.15))
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        flushed = 0
        try:
            while True:
                flushed = receiver.recv()
        except EOFError:
            pass
        if not flushed:
            continue
        recovery = recover(bag)
        saved = torn_bags.contents(recovery.bag)
        assert len(saved) >= flushed
        assert saved == [
            (f"/topic_{index % 3}", 1000 + index, 7 * index, _payload(index))
            for index in range(len(saved))
        ]
        saved_counts.append(len(saved))
        shutil.rmtree(bag)
    assert len(saved_counts) >= 19
    assert len(set(saved_counts)) > 10


def test_a_cut_at_any_place_keeps_what_is_whole_before_it(run, files, tmp_path):
    content = files["plain"]
    messages, ends = torn_bags.contents(run), torn_bags.message_ends(files["plain"])
    records = [8, *(end for _, _, end in torn_bags.boundaries(content))]
    chance = random.Random(2)
    places = {place + shift for place in records for shift in (-1, 0, 1)}
    places |= {chance.randrange(8, len(content)) for _ in range(100)}
    for place in sorted(places):
        torn = torn_bags.copy_with(run, tmp_path / "torn", content[:place])
        if place < 8:
            with pytest.raises(FileError, match="holds nothing that could be recovered"):
                recover(torn, tmp_path / "new")
            continue
        recovery = recover(torn, tmp_path / "new")
        count = sum(end <= place for end in ends)
        assert torn_bags.contents(recovery.bag) == messages[:count], place
        assert recovery.bytes_left == place - max(end for end in records if end <= place), place
        shutil.rmtree(recovery.bag)


@pytest.mark.parametrize("variant", ["chunks", "lz4", "zstd"])
def test_a_cut_in_a_chunk_keeps_its_whole_messages(run, files, tmp_path, variant):
    content, messages = files[variant], torn_bags.contents(run)
    ends: list[int] = []  # of the messages, where they can be found in the file
    for opcode, begin, end in torn_bags.boundaries(content):
        if opcode == Opcode.CHUNK and variant == "chunks":
            inside = content[begin + 9 + 40 : end]
            framed = torn_bags.boundaries(bytes(8) + inside + bytes(8))
            ends += [begin + 49 - 8 + stop for kind, _, stop in framed if kind == Opcode.MESSAGE]
    chance, counts = random.Random(3), []
    for place in sorted(chance.randrange(100, len(content)) for _ in range(40)):
        torn = torn_bags.copy_with(run, tmp_path / "torn", content[:place])
        recovery = recover(torn, tmp_path / "new")
        saved = torn_bags.contents(recovery.bag)
        assert saved == messages[: len(saved)]
        if variant == "chunks":
            assert len(saved) == sum(end <= place for end in ends)
        counts.append(len(saved))
        shutil.rmtree(recovery.bag)
    assert counts == sorted(counts)
    assert counts[-1] == len(messages)


@pytest.mark.parametrize("first_seed", range(0, 60, 20))
def test_damaged_bags_end_with_success_or_a_sentence(run, files, tmp_path, first_seed):
    """Some of the damage of bench/endurance/fuzz_bags.py, which tries thousands."""
    originals = set(torn_bags.contents(run))
    for seed in range(first_seed, first_seed + 20):
        chance = random.Random(seed)
        kind = chance.choice(sorted(files))
        way, content = torn_bags.mutated(files[kind], chance)
        torn = torn_bags.copy_with(run, tmp_path / "torn", content)
        shutil.rmtree(tmp_path / "new", ignore_errors=True)
        started = time.monotonic()
        recovery = _ended_well(recover, torn, tmp_path / "new")
        for bag in (torn, *([recovery.bag] if recovery else [])):
            run_in_bag = _ended_well(read_run, bag)
            if run_in_bag is not None:
                _ended_well(replay, run_in_bag)
        assert time.monotonic() - started < 10.0, (seed, kind, way)
        if recovery and kind in ("lz4", "zstd"):  # what has checksums comes out as it was
            assert set(torn_bags.contents(recovery.bag)) <= originals, (seed, kind, way)


def test_analyses_of_damaged_bags_end_with_success_or_a_sentence(tmp_path):
    """All of the learner's topics; pages and figures of a few, for they take most of the time."""
    pytest.importorskip("plotly", reason="the report needs the extra 'report'")
    from adp_path_follower.analysis.bag_page import write_report

    torn_bags.write_run(tmp_path / "run", steps=20, profiles=(), learner=True)
    whole = torn_bags.variants(tmp_path / "run")["plain"]
    analyses = []
    for seed in range(24):
        way, content = torn_bags.mutated(whole, random.Random(seed))
        torn = torn_bags.copy_with(tmp_path / "run", tmp_path / "torn", content)
        shutil.rmtree(tmp_path / "new", ignore_errors=True)
        recovery = _ended_well(recover, torn, tmp_path / "new")
        for bag in (torn, *([recovery.bag] if recovery else [])):
            found = _ended_well(analyse_bag, bag, {}, 1, tmp_path / "trajectory.tum")
            if found is not None and way in ("bit flips", "noise", "zeros", "swapped blocks"):
                analyses.append(found)
    assert len(analyses) >= 8
    for found in analyses[::8]:
        draw_bags([found], tmp_path / "figures")
        write_report([found], [], tmp_path / "report.html")


def _ended_well(task: Callable[..., Any], *arguments: Any) -> Any:
    """Return what a task gives, or None if it ended with one sentence."""
    try:
        return task(*arguments)
    except AdpError as error:
        sentence = str(error)
    assert len(sentence.splitlines()) == 1
    return None


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e308])
def test_a_pose_that_no_robot_has_is_one_sentence(run, value):
    read = read_run(run)
    odometry = read.series["odom"]
    odometry.values[3, 0] = value
    with pytest.raises(FileError, match=r"not finite|no command follows from the pose"):
        replay(read)


@pytest.mark.parametrize("text", ["", "\0", "settings: [1]", "settings: {1: 2}", "[", "5"])
def test_a_configuration_that_makes_no_sense_is_one_sentence(run, text):
    read = dataclasses.replace(read_run(run), configurations=((0, text),))
    with pytest.raises(FileError, match="no sound path_follower/configuration"):
        replay(read)


def test_declared_lengths_take_no_memory(run, files, tmp_path):
    """Recover a file of 150 MB, almost all a hole, with lengths of up to 2^64 in it."""
    content = bytearray(files["plain"])
    frames = [begin for opcode, begin, _ in torn_bags.boundaries(content) if opcode == 5]
    for number, length in enumerate((2**27, 2**28, 2**40, 2**63, 2**64 - 1)):
        begin = frames[2 + 3 * number]
        content[begin + 1 : begin + 9] = length.to_bytes(8, "little")
    bag = torn_bags.copy_with(run, tmp_path / "bag", bytes(content))
    with (bag / "run_0.mcap").open("r+b") as stream:
        stream.truncate(150_000_000)
    script = (
        "import re, sys\n"
        "from pathlib import Path\n"
        "from adp_path_follower.bags.recovery.recover import recover\n"
        "print(sum(recover(Path(sys.argv[1])).message_counts.values()))\n"
        # Not `ru_maxrss`, which begins with the memory of the process that has started this one.
        "status = Path('/proc/self/status').read_text()\n"
        "print(int(re.search(r'VmHWM:\\s+(\\d+)', status)[1]) // 1024)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(bag)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    saved, megabytes = (int(line) for line in done.stdout.split())
    assert saved == len(frames) - 5
    assert megabytes < 500
