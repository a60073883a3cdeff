"""The rows of the table of faults in docs/safety.md."""

from __future__ import annotations

AGAIN = "goes on with the next sound message"
SETTLED = "goes on after 0.2 s of sound messages"
# How each fault is injected, what the robot does after zero velocity, and which test does the same.
# A test compares the names with docs/safety.md.
FAULTS = {
    "odometry is not a number": ("x is NaN", SETTLED, "bad_odometry_stops_the_robot"),
    "odometry is infinite": ("y is infinite", SETTLED, "bad_odometry_stops_the_robot"),
    "orientation of zero norm": ("z = w = 0", SETTLED, "bad_odometry_stops_the_robot"),
    "every second message is wrong": ("x is NaN", SETTLED, "wrong_odometry_now_and_then"),
    "odometry is 1 s old by its stamp": ("stamps 1 s back", SETTLED, "odometry_that_stays_wrong"),
    "odometry is an hour ahead": ("stamps 1 h ahead", SETTLED, "odometry_that_stays_wrong"),
    "odometry stamps go back": ("stamps 0.3 s back", SETTLED, "one_message_that_cannot_be"),
    "odometry says 50 m/s": ("v", SETTLED, "odometry_that_stays_wrong"),
    "odometry of another robot frame": ("child_frame_id", SETTLED, "odometry_that_stays_wrong"),
    "odometry without a frame": ("frame_id is empty", SETTLED, "odometry_that_stays_wrong"),
    "odometry in another frame": (
        "frame_id",
        "waits for a path in it",
        "odometry_in_another_frame",
    ),
    "odometry jumps by 3 m": ("x + 3 m", SETTLED, "one_message_that_cannot_be"),
    "odometry turns by half a turn": ("heading + pi", SETTLED, "one_message_that_cannot_be"),
    "odometry ends (timeout 0.5 s)": ("no more messages", AGAIN, "bad_odometry_stops_the_robot"),
    "the odometry source stalls (timeout 0.5 s)": (
        "kill -STOP of the simulator",
        AGAIN,
        "the_robot_stops_when_odometry_stalls",
    ),
    "the odometry source dies (timeout 0.5 s)": (
        "kill -9 of the simulator",
        "waits for ~/resume where it begins anew",
        "the_robot_stops_when_odometry_stalls",
    ),
    "/clock stands still (timeout 0.5 s)": (
        "no more /clock",
        "goes on with the clock",
        "a_clock_that_does_not_start",
    ),
    "/clock goes back": ("/clock and stamps 0.3 s back", SETTLED, "a_clock_that_does_not_start"),
    "an empty path": ("a path without poses", "waits for a path", "an_empty_path_stops"),
    "~/stop": ("the service", "waits for ~/resume", "stop_and_resume"),
    "a speed limit of 0": (
        "the topic speed_limit",
        "goes on with a limit above 0",
        "a_speed_limit_that_cannot_hold",
    ),
    "max_cross_track_error": ("y + 0.1 m", "waits for ~/resume", "too_far_from_the_path"),
    "max_heading_error": ("heading + 0.5 rad", "waits for ~/resume", "turned_too_far"),
    "deactivate": ("lifecycle transition", "waits for activate", "a_lifecycle_transition_stops"),
    "shutdown": ("lifecycle transition", "the process ends", "a_lifecycle_transition_stops"),
    "SIGINT": ("kill -INT", "the process ends", "says_stop_three_times"),
    "SIGTERM": ("kill -TERM", "the process ends", "says_stop_three_times"),
    "SIGHUP": ("kill -HUP", "the process ends", "says_stop_three_times"),
    "the launcher dies": ("kill -9 of the parent", "the process ends", "whoever_launched"),
    "an exception in a callback": (
        "a defective controller",
        "the process ends with code 1",
        "an_exception_in_a_callback",
    ),
    "a transition that fails": (
        "a defective controller",
        "the process ends with code 1",
        "a_transition_that_fails",
    ),
    "a control step that hangs (timeout 0.5 s)": (
        "a defective controller",
        "goes on when it does",
        "a_node_that_hangs",
    ),
    "anything else that hangs (timeout 0.5 s)": (
        "a defective controller",
        "goes on when it does",
        "a_node_that_hangs",
    ),
    "the controller stalls (command_timeout 0.5 s)": (
        "kill -STOP",
        "the base stops by itself",
        "the_base_stops_by_itself",
    ),
    "the controller dies (command_timeout 0.5 s)": (
        "kill -9",
        "the base stops by itself",
        "the_base_stops_by_itself",
    ),
}

# Those of the other groups; all the rest are `recoverable`.
GROUPS = {
    "clocks": [name for name in FAULTS if name.startswith("/clock")],
    "processes": [name for name in FAULTS if "stalls" in name or "source dies" in name]
    + ["the controller dies (command_timeout 0.5 s)"],
    "final": [
        *("SIGINT", "SIGTERM", "SIGHUP", "shutdown", "the launcher dies"),
        *("an exception in a callback", "a transition that fails"),
        "a control step that hangs (timeout 0.5 s)",
        "anything else that hangs (timeout 0.5 s)",
    ],
}
GROUPS["recoverable"] = [
    name for name in FAULTS if not any(name in group for group in GROUPS.values())
]


def table(found: dict[str, list[float]]) -> str:
    """Return the table of docs/safety.md; it names the tests by a part of their names."""
    lines = [
        "| fault | injected by | then | median | worst | test |",
        "|---|---|---|---|---|---|",
    ]
    for name, (how, then, test) in FAULTS.items():
        times = "| | |"
        if found.get(name):
            median, worst = sorted(found[name])[len(found[name]) // 2], max(found[name])
            times = f"| {1e3 * median:.0f} ms | {1e3 * worst:.0f} ms |"
        lines.append(f"| {name} | {how} | {then} {times} `{test}` |")
    return "\n".join(lines)
