"""A driver's step is its command, then what the step teaches."""

import numpy as np
import pytest

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.geometry import advance_pose
from adp_path_follower.core.path.library import circle
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

PERIOD = 10_000_000  # [ns]
START = np.array([0.1, 0.2, 1.0])
kinds = pytest.mark.parametrize("scheduling", ["arc_length", "path_state"])


def driver(scheduling):
    found = Driver(build(Settings, {"scheduling": scheduling}))
    found.follow(circle(0.5))
    return found


def drive(steps, step):
    """Return the commands of a robot that does what each step says, by the step's number."""
    pose, commands = START, []
    for number in range(steps):
        commands.append(step(pose, number))
        pose = advance_pose(pose, *commands[-1].tolist(), 1e-9 * PERIOD)
    return np.array(commands)


def weights(found):
    return np.concatenate([found.follower.weights.critic, found.follower.weights.actor])


@kinds
def test_both_halves_are_the_whole_to_the_last_bit(scheduling):
    whole, halves = driver(scheduling), driver(scheduling)

    def both(pose, number):
        output = halves.command_for(pose, number * PERIOD)
        halves.learn()
        halves.learn()  # there is nothing left to learn from
        return output.command

    expected = drive(60, lambda pose, number: whole.step(pose, number * PERIOD).command)
    assert drive(60, both).tobytes() == expected.tobytes()
    assert weights(whole).tobytes() == weights(halves).tobytes()
    assert np.ptp(expected[:, 1]) > 0.01


@kinds
def test_a_command_alone_teaches_nothing(scheduling):
    found = driver(scheduling)
    drive(60, lambda pose, number: found.step(pose, number * PERIOD).command)
    output = found.command_for(START, 60 * PERIOD)
    before = weights(found)
    assert (
        before.tobytes() == np.concatenate([output.weights.critic, output.weights.actor]).tobytes()
    )
    found.learn()
    assert weights(found).tobytes() != before.tobytes()


@kinds
def test_a_step_before_a_reset_teaches_nothing_after_it(scheduling):
    resets = [driver(scheduling) for _ in range(2)]

    def whole(pose, number):
        output = resets[0].step(pose, number * PERIOD)
        if number == 30:
            resets[0].reset_learning()
        return output.command

    def halves(pose, number):
        output = resets[1].command_for(pose, number * PERIOD)
        if number == 30:
            resets[1].reset_learning()
        resets[1].learn()
        return output.command

    assert drive(60, whole).tobytes() == drive(60, halves).tobytes()
    assert weights(resets[0]).tobytes() == weights(resets[1]).tobytes()
