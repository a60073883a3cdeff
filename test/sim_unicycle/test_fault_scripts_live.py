"""A bad day with real nodes: each scripted fault is seen, and the robot goes on after it."""

from __future__ import annotations

import pytest
import yaml
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger

pytestmark = pytest.mark.nodes

BAD_DAY = [
    ({"for": 0.2, "odometry_corruption": "nan"}, "odometry is not finite"),
    ({"for": 0.2, "odometry_corruption": "zero_quaternion"}, "quaternion of zero norm"),
    ({"for": 0.2, "odometry_offset": [3.0, 0.0, 0.0]}, "odometry jumped by"),
    ({"for": 0.02, "odometry_stamp_offset": -0.3}, "odometry stamps went back"),
    ({"for": 0.2, "odometry_stamp_offset": -1.5}, "s old by its stamp"),
    ({"for": 0.2, "reported_base_frame": "other"}, "odometry is of 'other' now"),
    ({"for": 0.9, "odometry_drop": 1.0}, "no odometry for more than 0.5 s"),
    ({"for": 0.9, "clock_stops": True}, "no control step for more than 0.5 s"),
    ({"for": 1.0, "clock_offset": -2.0}, "went back"),
]
# A fault is over in a moment, and a busy machine may sleep through it: the day comes round again.
DAY = 1.5 * (1 + len(BAD_DAY))  # [s]


def seconds(message: Odometry) -> float:
    """Return the stamp of a message [s]."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def test_every_fault_of_a_script_is_seen_and_the_robot_goes_on_after_it(peer, start, tmp_path):
    script = tmp_path / "bad_day.yaml"
    entries = [
        {"at": 1.0 + 1.5 * index, "every": DAY, **fault} for index, (fault, _) in enumerate(BAD_DAY)
    ]
    script.write_text(yaml.safe_dump({"faults": entries}))
    truth = peer.listen(Odometry, "ground_truth")
    controller = start("controller", use_sim_time=True)
    start("path_publisher", path="line")
    start("sim_unicycle", publish_clock=True, fault_script=str(script))
    for _, cause in BAD_DAY:
        peer.until(lambda cause=cause: cause in controller.output(), cause, timeout=4.0 * DAY)

    def goes_on() -> bool:
        last = controller.output().strip().splitlines()[-1]
        return last.endswith("following") and truth[-1].twist.twist.linear.x > 0.3

    peer.until(goes_on, "the drive after all of it")
    faults = [line for line in controller.output().splitlines() if "fault: " in line]
    # A line or two each, and none of other faults: no flood of messages. Odometry that is under
    # way while the clock goes back is ahead of it.
    known = [*(cause for _, cause in BAD_DAY), "s ahead by its stamp"]
    assert all(any(cause in line for cause in known) for line in faults)
    days = 1.0 + seconds(truth[-1]) / DAY
    assert len(faults) < 3 * len(BAD_DAY) * days


def test_odometry_that_is_late_and_lost_does_not_hold_lock_step_up(peer, start):
    odometry = peer.listen(Odometry, "odom")
    truth = peer.listen(Odometry, "ground_truth")
    commands = peer.node.create_publisher(TwistStamped, "cmd_vel", 10)
    received = len(odometry)

    def answer() -> None:
        nonlocal received
        for message in odometry[received:]:
            command = TwistStamped(header=message.header)
            command.twist.linear.x = 1.0
            commands.publish(command)
        received = len(odometry)

    peer.node.create_timer(0.002, answer)
    start("sim_unicycle", lockstep=True, odometry_drop=0.5, odometry_delay=0.03, rate=100.0)

    peer.until(lambda: truth and seconds(truth[-1]) > 5.0, "five simulated seconds")
    stamps = {
        item.header.stamp.sec * 1_000_000_000 + item.header.stamp.nanosec for item in odometry
    }
    assert all(stamp % 10_000_000 == 0 for stamp in stamps)
    # Half of about 500; four standard deviations are 45.
    assert 205 < sum(stamp <= 5_000_000_000 for stamp in stamps) < 295
    # Every command but those of the first steps moved the robot: straight on at 1 m/s.
    last = truth[-1]
    assert last.pose.pose.position.x == pytest.approx(seconds(last), abs=0.15)
    assert peer.call(Trigger, "unicycle_sim/reset").success


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({"fault_script": "clock_stops", "lockstep": True}, "but lock-step waits for an answer"),
        ({"fault_script": "missing.yaml"}, "file missing.yaml cannot be read"),
    ],
)
def test_a_script_that_cannot_be_played_is_refused_in_one_sentence(start, parameters, expected):
    node = start("sim_unicycle", **parameters)
    assert node.process.wait(30.0) == 2
    assert expected in node.output()
    assert len(node.output().strip().splitlines()) == 1
