"""Measure how long paths take to prepare, and how long a control thread waits meanwhile.

    python bench/speed/paths.py [--poses 100000]

A path of many poses is prepared from the bytes of its message in a process of its own, as the
controller does, or in a thread, while another thread does a control step every 10 ms. Shown are the
time of the preparation, how late the latest of those steps ended against the same steps with
nothing beside them, and how long the first step on the new path takes.
"""

from __future__ import annotations

import argparse
import math
import struct
import threading
import time
from collections.abc import Callable

import numpy as np

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.path.library import lissajous
from adp_path_follower.core.path.route import Route
from adp_path_follower.core.settings.groups import PathSettings, Settings
from adp_path_follower.core.settings.parameter_file import load_settings
from adp_path_follower.ros.controller.path_process import Fit, FittingProcess, route_of_message

_PERIOD = 0.01  # [s]


def message(points: np.ndarray) -> bytes:
    """Return a serialised nav_msgs/Path of points (N, 2), oriented along it."""
    headings = np.arctan2(np.gradient(points[:, 1]), np.gradient(points[:, 0]))
    frame = struct.pack("<I", 5) + b"odom\0"
    head = b"\0\1\0\0" + bytes(8) + frame + bytes(3) + struct.pack("<I", len(points))
    row = np.dtype([("stamp", "V8"), ("frame", "V9"), ("gap", "V7"), ("numbers", "<f8", 7)])
    rows = np.zeros(len(points), row)
    rows["frame"] = np.void(frame)
    rows["numbers"][:, :2] = points
    rows["numbers"][:, 5], rows["numbers"][:, 6] = np.sin(headings / 2), np.cos(headings / 2)
    # The first pose starts at a multiple of 8 from the encapsulation on, as all that follow do.
    assert (len(head) - 4) % 8 == 0
    return head + rows.tobytes()


def paths(count: int) -> dict[str, np.ndarray]:
    """Return paths of so many poses, by name."""
    rng = np.random.default_rng(0)
    along = np.arange(count) * 0.05
    wave = np.stack([along, 20.0 * np.cos(along / 31.0)], axis=1)
    side = max(1, count // 200)
    turns = np.cumsum(np.r_[0.0, np.where(np.arange(count - 1) // side % 2, 1.0, -1.0)])
    zigzag = np.stack([along, 0.05 * turns], axis=1)
    return {
        "smooth": wave,
        "noise of 1 cm": wave + rng.normal(0.0, 0.01, wave.shape),
        f"{count // side} corners of 90°": zigzag,
        "poses 1 m apart": 20.0 * wave,
    }


def driver_under_way() -> Driver:
    """Return a driver that has followed another path for a while."""
    driver = Driver(load_settings(Settings, "path_follower"))
    driver.follow(lissajous())
    for step in range(200):
        driver.step(np.array([0.3, 0.5, 0.4]), step * 10_000_000)
    return driver


def steps(ready: threading.Event, stop: threading.Event) -> np.ndarray:
    """Return how long after its due time each control step ended [s], between two events."""
    driver, pose = driver_under_way(), np.array([0.3, 0.5, 0.4])
    ready.set()
    late, due = [], time.perf_counter()
    while not stop.is_set():
        due = max(due + _PERIOD, time.perf_counter() - _PERIOD)
        time.sleep(max(0.0, due - time.perf_counter()))
        driver.step(pose, time.monotonic_ns())
        late.append(time.perf_counter() - due)
    return np.array(late)


def watched(work: Callable[[], object]) -> tuple[float, np.ndarray]:
    """Return how long work takes in a thread [s], and how late control steps end meanwhile [s]."""
    ready, stop, elapsed = threading.Event(), threading.Event(), [math.nan]

    def run() -> None:
        ready.wait()
        time.sleep(0.1)
        begun = time.perf_counter()
        try:
            work()
        finally:
            elapsed[0] = time.perf_counter() - begun
            stop.set()

    thread = threading.Thread(target=run)
    thread.start()
    late = steps(ready, stop)
    thread.join()
    return elapsed[0], late


def first_step(route: Route) -> float:
    """Return how long the first step on a new route takes [s], the least of three."""
    times = []
    for _ in range(3):
        driver = driver_under_way()
        driver.follow(route)
        pose = route.segments[0].path.frame(0.0).pose
        begun = time.perf_counter()
        driver.step(pose, 3_000_000_000)
        times.append(time.perf_counter() - begun)
    return min(times)


def show(name: str, points: np.ndarray, fit: Fit) -> None:
    """Print a line of the table."""
    raw = message(points)
    routes = [fit(raw, PathSettings())]
    begun = time.perf_counter()
    routes.append(fit(raw, PathSettings()))
    alone = time.perf_counter() - begun
    beside, late = watched(lambda: routes.append(fit(raw, PathSettings())))
    print(
        f"{len(points)} poses, {name:<20} {alone:.2f} s, beside control steps {beside:.2f} s; the "
        f"latest step {1e3 * late.max():5.1f} ms late; the first on it "
        f"{1e3 * first_step(routes[-1]):4.1f} ms"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=100_000)
    count = parser.parse_args().poses
    with FittingProcess() as fitting:
        _, alone = watched(lambda: time.sleep(2.0))
        print(f"control steps alone: the latest {1e3 * alone.max():.1f} ms late")
        for text, fit in (("a process", fitting.route), ("a thread", route_of_message)):
            print(f"prepared in {text}:")
            for name, points in paths(count).items():
                show(name, points, fit)


if __name__ == "__main__":
    main()
