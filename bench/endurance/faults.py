"""Measure the time from a fault to zero velocity, with real processes over real DDS.

    python bench/endurance/faults.py [--runs 20] [--group NAME ...] [--only TEXT] [--json FILE]

With `--json` new times replace those in the file. `--table` measures nothing: it takes the times of
`--json`, if given, into fault_times.json, and writes the table in docs/safety.md.

A controller follows a line; the fault is injected again and again, each time after it has been
seen to move the robot. Time is from the injection until a command of zero velocity is received, so
it includes the delays of DDS and of a busy machine, and the timeout if one finds the fault.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path as FilePath
from typing import Any

from fault_robots import (  # before the next, which it makes known
    Alternating,
    Bench,
    from_last_motion,
)
from fault_table import GROUPS, TIMES, summary, with_table

# isort: split
# The tests' nodes, a peer on their domain and defective controllers.
from geometry_msgs.msg import TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Path as PathMessage
from std_msgs.msg import Float64, Header
from std_srvs.srv import Trigger
from test_left_alone import DEFECTIVE_TRANSITION
from test_node import BROKEN_CONTROLLER
from test_other_processes import Team
from test_safety import HANGING_CONTROLLER, SimulatedTime

from adp_path_follower.study.demo import own_domain
from live_nodes import Drive, Peer, is_zero

PAGE = FilePath(__file__).resolve().parents[2] / "docs" / "safety.md"
NAN, INFINITE = float("nan"), float("inf")
ELSEWHERE = "from where it was"  # of odometry that has begun anew
_DEACTIVATE = Transition.TRANSITION_DEACTIVATE
ODOMETRY = {
    "odometry is not a number": {"x": NAN},
    "odometry is infinite": {"y": INFINITE},
    "orientation of zero norm": {"qw": 0.0, "qz": 0.0},
    "odometry is 1 s old by its stamp": {"later": -1.0},
    "odometry is an hour ahead": {"later": 3600.0},
    "odometry stamps go back": {"later": -0.3},
    "odometry says 50 m/s": {"v": 50.0},
    "odometry of another robot frame": {"child_frame_id": "other"},
    "odometry without a frame": {"frame_id": ""},
    "odometry jumps by 3 m": {"x": 3.0},
    "odometry turns by half a turn": {"qz": 1.0, "qw": 0.0},
}


def until_zero(peer: Peer, commands: list[Any], since: float) -> float:
    """Return the time since a moment until a command of zero velocity comes [s]."""
    seen = len(commands)
    peer.until(lambda: any(map(is_zero, commands[seen:])), "zero velocity")
    return time.monotonic() - since


def injected(
    drive: Drive, inject: Callable[[], None], repair: Callable[[], None], runs: int
) -> list[float]:
    """Return the times to zero velocity of faults that a running controller recovers from."""
    times = []
    for run in range(runs):
        drive.until_moving()
        drive.peer.pause(0.3 + 0.0037 * run)  # at another moment of the period each time
        begun = time.monotonic()
        inject()
        times.append(until_zero(drive.peer, drive.commands, begun))
        repair()
    return times


def recoverable(bench: Bench, runs: int) -> Iterator[tuple[str, list[float]]]:
    """Yield each fault that the controller recovers from, with its times."""
    with bench.drive() as drive:
        peer = drive.peer

        def feed(values: dict[str, Any] | None) -> None:
            drive.odometry = values
            if values is not None:
                drive._send()  # at once, not with the next period of the test's timer

        for name, values in ODOMETRY.items():
            yield (
                name,
                injected(drive, lambda values=values: feed(dict(values)), lambda: feed({}), runs),
            )

        wrong = Alternating(drive)
        yield "every second message is wrong", injected(drive, wrong.begin, wrong.end, runs)
        yield (
            "odometry ends (timeout 0.5 s)",
            injected(drive, lambda: feed(None), lambda: feed({}), runs),
        )
        empty = PathMessage(header=Header(frame_id="odom"))
        yield (
            "an empty path",
            injected(
                drive, lambda: peer.path.publish(empty), lambda: peer.send_path() and None, runs
            ),
        )
        stop = peer.node.create_client(Trigger, "path_follower/stop")
        yield (
            "~/stop",
            injected(
                drive,
                lambda: stop.call_async(Trigger.Request()) and None,
                lambda: peer.call(Trigger, "path_follower/resume") and None,
                runs,
            ),
        )

        limit = peer.node.create_publisher(Float64, "speed_limit", 1)
        yield (
            "a speed limit of 0",
            injected(
                drive,
                lambda: limit.publish(Float64(data=0.0)),
                lambda: limit.publish(Float64(data=1.0)),
                runs,
            ),
        )

        def back_on_the_path() -> None:
            feed({})
            peer.pause(0.3)
            peer.call(Trigger, "path_follower/resume")

        limits = {
            "max_cross_track_error": (0.15, {"y": 0.2}),
            "max_heading_error": (0.3, {"qz": 0.2474, "qw": 0.9689}),
        }
        for name, (limit, values) in limits.items():
            peer.set_parameter("path_follower", name, limit)
            inject = functools.partial(feed, values)
            yield name, injected(drive, inject, back_on_the_path, runs)
            peer.set_parameter("path_follower", name, INFINITE)

        def back_in_the_frame() -> None:
            feed({})
            peer.pause(0.2)
            peer.send_path()

        yield (
            "odometry in another frame",
            injected(drive, lambda: feed({"frame_id": "map"}), back_in_the_frame, runs),
        )
        yield (
            "deactivate",
            injected(
                drive,
                lambda: _transition(peer, Transition.TRANSITION_DEACTIVATE),
                lambda: _transition(peer, Transition.TRANSITION_ACTIVATE),
                runs,
            ),
        )


def _transition(peer: Peer, number: int) -> None:
    """Ask the controller for a transition, and do not wait for the answer."""
    name = "path_follower/change_state"
    client = peer.node.create_client(ChangeState, name)
    peer.until(client.service_is_ready, name)
    client.call_async(ChangeState.Request(transition=Transition(id=number)))


def clocks(bench: Bench, runs: int) -> Iterator[tuple[str, list[float]]]:
    """Yield the faults of /clock, with their times."""
    with bench.nodes() as (peer, start):
        commands = peer.listen(TwistStamped, "cmd_vel")
        start("controller", use_sim_time=True)
        peer.until_matched(peer.path)
        peer.send_path()
        clock = SimulatedTime(peer)
        clock.time = 100.0

        def stand_still() -> None:
            clock.runs = False

        def go_on() -> None:
            clock.runs = True

        def go_back() -> None:
            clock.time -= 0.3

        for name, inject in (
            ("/clock stands still (timeout 0.5 s)", stand_still),
            ("/clock goes back", go_back),
        ):
            times = []
            for run in range(runs):
                commands.clear()
                peer.until(lambda: len(commands) > 20 and not is_zero(commands[-1]), "motion")
                peer.pause(0.3 + 0.0037 * run)
                begun = time.monotonic()
                inject()
                times.append(until_zero(peer, commands, begun))
                go_on()
            yield name, times


def processes(bench: Bench, runs: int) -> Iterator[tuple[str, list[float]]]:
    """Yield the faults of processes that stall and die, with the times."""
    with bench.nodes() as (peer, start):
        team = Team(peer, start)

        def told() -> bool:
            return bool(team.commands) and is_zero(team.commands[-1])

        def at_rest() -> bool:
            return bool(team.truth) and team.truth[-1].twist.twist.linear.x == 0.0

        def new_simulator() -> None:
            told, seen = team.controller.output().count(ELSEWHERE), len(team.commands)
            team.simulator = start("sim_unicycle", theta=1.249)

            def is_elsewhere() -> bool:
                return team.controller.output().count(ELSEWHERE) > told

            peer.until(
                lambda: is_elsewhere() or not all(map(is_zero, team.commands[seen:])),
                "its odometry",
            )
            if is_elsewhere():
                peer.call(Trigger, "path_follower/resume")

        def new_controller() -> None:
            team.controller = start("controller")

        def go_on(executable: str) -> None:
            os.kill(getattr(team, executable).process.pid, signal.SIGCONT)

        cases: tuple[tuple[str, str, int, Callable[[], bool], Callable[[], None]], ...] = (
            (
                "the odometry source stalls (timeout 0.5 s)",
                "simulator",
                signal.SIGSTOP,
                told,
                lambda: go_on("simulator"),
            ),
            (
                "the odometry source dies (timeout 0.5 s)",
                "simulator",
                signal.SIGKILL,
                told,
                new_simulator,
            ),
            (
                "the controller stalls (command_timeout 0.5 s)",
                "controller",
                signal.SIGSTOP,
                at_rest,
                lambda: go_on("controller"),
            ),
            (
                "the controller dies (command_timeout 0.5 s)",
                "controller",
                signal.SIGKILL,
                at_rest,
                new_controller,
            ),
        )
        for name, executable, number, stopped, repair in cases:
            times = []
            for run in range(runs):
                team.until_moving()
                peer.pause(0.2 + 0.0037 * run)
                begun = time.monotonic()
                os.kill(getattr(team, executable).process.pid, number)
                peer.until(stopped, name)
                times.append(time.monotonic() - begun)
                repair()
            yield name, times


def final(bench: Bench, runs: int) -> Iterator[tuple[str, list[float]]]:
    """Yield each fault that ends the controller, or a step of it, with its times."""
    ends: dict[str, Callable[[Drive], None]] = {
        number.name: lambda drive, number=number: os.killpg(drive.controller.process.pid, number)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    ends["shutdown"] = lambda drive: _transition(drive.peer, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    for name, end in ends.items():
        times = []
        for _ in range(runs if bench.wanted(name) else 0):
            with bench.drive() as drive:
                begun = time.monotonic()
                end(drive)
                times.append(until_zero(drive.peer, drive.commands, begun))
        yield name, times
    name, times = "the launcher dies", []
    for _ in range(runs if bench.wanted(name) else 0):
        with bench.orphan() as (drive, launcher):
            begun = time.monotonic()
            launcher.kill()
            times.append(until_zero(drive.peer, drive.commands, begun))
    yield name, times
    defects = {
        "an exception in a callback": BROKEN_CONTROLLER,
        "a control step that hangs (timeout 0.5 s)": HANGING_CONTROLLER.format(
            owner="PathFollower", name="step_at"
        ),
        "anything else that hangs (timeout 0.5 s)": HANGING_CONTROLLER.format(
            owner="PathInput", name="odometry_in"
        ),
    }
    for name, code in defects.items():
        times = []
        for _ in range(runs if bench.wanted(name) else 0):
            with bench.defective(code) as peer:
                times.append(from_last_motion(peer))
        yield name, times
    name, times = "a transition that fails", []
    code = DEFECTIVE_TRANSITION.format(owner="Telemetry", name="deliver_status")
    for _ in range(runs if bench.wanted(name) else 0):
        with bench.defective(code) as peer:
            times.append(from_last_motion(peer, lambda to: _transition(to, _DEACTIVATE)))
    yield name, times


def main() -> None:
    """Measure and print the times, or write the table of docs/safety.md."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=20, help="of each fault (default: 20)")
    parser.add_argument("--only", default="", help="part of the names of the faults to measure")
    parser.add_argument(
        "--group", choices=GROUPS, nargs="+", default=list(GROUPS), help="of faults to measure"
    )
    parser.add_argument("--json", type=FilePath, help="read and write the times [s] here")
    parser.add_argument("--table", action="store_true", help="write the table of docs/safety.md")
    arguments = parser.parse_args()
    found: dict[str, list[float]] = {}
    if arguments.json and arguments.json.exists():
        found = json.loads(arguments.json.read_text(encoding="utf-8"))
    if arguments.table:
        write_table(found)
        return
    print(f"{'fault':<48}{'median':>10}{'worst':>10}   time to zero velocity [ms]")
    with own_domain() as domain, tempfile.TemporaryDirectory() as folder:
        bench = Bench(domain, FilePath(folder), arguments.only)
        groups = (recoverable, clocks, processes, final)
        for group in (item for item in groups if item.__name__ in arguments.group):
            for name, times in _wanted(bench, group, arguments.runs):
                found[name] = sorted(times)
                median = 1e3 * found[name][len(times) // 2]
                print(f"{name:<48}{median:10.0f}{1e3 * max(times):10.0f}", flush=True)
                if arguments.json:
                    text = json.dumps(found, indent=2) + "\n"
                    arguments.json.write_text(text, encoding="utf-8")
    print(f"load: {os.getloadavg()}")


def write_table(found: dict[str, list[float]]) -> None:
    """Take new times [s] into fault_times.json, and write the table in docs/safety.md."""
    times = json.loads(TIMES.read_text(encoding="utf-8"))
    times |= {name: summary(values) for name, values in found.items()}
    rows = [f"  {json.dumps(name)}: {json.dumps(pair)}" for name, pair in times.items()]
    TIMES.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(with_table(page, times), encoding="utf-8")


def _wanted(
    bench: Bench, group: Callable[[Bench, int], Iterator[tuple[str, list[float]]]], runs: int
) -> Iterator[tuple[str, list[float]]]:
    """Yield the faults of a group that are to be measured."""
    if bench.wanted(*GROUPS[group.__name__]):
        for name, times in group(bench, runs):
            if bench.wanted(name) and times:
                yield name, times


if __name__ == "__main__":
    main()
