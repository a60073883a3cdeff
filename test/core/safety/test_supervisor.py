"""The supervisor against what its history allows: the robot moves only if nothing forbids it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adp_path_follower.core.safety.odometry_check import OdometryProblem
from adp_path_follower.core.safety.supervisor import State, Supervisor, deviation
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import build

TIMEOUT = 0.5
EVENTS = [
    *("activate", "deactivate", "path", "no path", "odometry", "bad odometry", "wait"),
    *("long wait", "goal", "refused", "tick", "no clock", "clock", "stop", "resume", "too far"),
    *("carried", "no limit", "limit", "renew"),
]
SETTLED = 0.2
BEGINNING = {"active": False, "path": False, "odometry": None, "problem": False, "goal": False}
BEGINNING |= {"tick": None, "clock": True, "stopped": False, "deviated": False, "limit": True}
BEGINNING |= {"sound_since": None}


def played(events):
    """Return the supervisor after these events, the time, and what the history amounts to."""
    supervisor, now = Supervisor(TIMEOUT), 100.0
    facts, refused = dict(BEGINNING), False
    for event in events:
        if event in ("activate", "deactivate"):
            supervisor.active = facts["active"] = event == "activate"
        elif event == "path":
            supervisor.path_received()
            facts.update(path=True, goal=False)
        elif event == "no path":
            supervisor.path_removed()
            facts["path"] = False
        elif event in ("odometry", "bad odometry"):
            if event == "bad odometry":
                supervisor.odometry_received(now, OdometryProblem("pose is not finite"))
                facts.update(problem=True, sound_since=None)
            else:
                supervisor.odometry_received(now)
                if facts["sound_since"] is None:
                    facts["sound_since"] = now
                facts["problem"] &= now - facts["sound_since"] < SETTLED
            facts["odometry"] = now
            refused = False
        elif event == "carried":
            supervisor.odometry_received(now, OdometryProblem("it is elsewhere", lasts=True))
            facts.update(odometry=now, problem=True, sound_since=None, deviated=True)
            refused = False
        elif event == "no limit":
            supervisor.limit_problem = "speed limit is 0"
            facts["limit"] = False
        elif event == "limit":
            supervisor.limit_problem = ""
            facts["limit"] = True
        elif event == "renew":
            supervisor = supervisor.renewed()
            facts.update({**BEGINNING, **{key: facts[key] for key in ("stopped", "deviated")}})
            refused = False
        elif event in ("wait", "long wait"):
            now += 0.25 if event == "wait" else 0.6
        elif event == "goal":
            supervisor.goal_reached = True
            facts["goal"] = True
        elif event == "tick":
            supervisor.tick_time = now
            facts["tick"] = now
        elif event in ("no clock", "clock"):
            supervisor.clock_missing = event == "no clock"
            facts["clock"] = event == "clock"
        elif event == "stop":
            supervisor.stop()
            facts["stopped"] = True
        elif event == "resume":
            supervisor.resume()
            facts.update(stopped=False, deviated=False)
        elif event == "too far":
            supervisor.deviation = "cross-track error is 2 m"
            facts["deviated"] = True
        else:
            supervisor.command_problem = "command is not finite"
            refused = True
    return supervisor, now, {**facts, "refused": refused}


@settings(max_examples=300)
@given(events=st.lists(st.sampled_from(EVENTS), max_size=14), ready=st.booleans())
def test_the_robot_moves_only_if_nothing_forbids_it(events, ready):
    start = ["activate", "path", "odometry"] if ready else []
    supervisor, now, facts = played([*start, *events])
    status = supervisor.status(now)
    odometry = facts["odometry"]
    stale = odometry is not None and now - odometry > TIMEOUT
    sound = odometry is not None and not stale and not facts["problem"] and not facts["refused"]
    ticking = facts["tick"] is None or now - facts["tick"] <= TIMEOUT
    allowed = facts["clock"] and not facts["stopped"] and not facts["deviated"] and ticking
    allowed = allowed and facts["limit"]
    may_move = facts["active"] and facts["path"] and sound and not facts["goal"] and allowed
    assert (status.state is State.FOLLOWING) == may_move
    assert bool(status.cause) == (status.state is not State.FOLLOWING)
    assert bool(status.remedy) == (status.state is not State.FOLLOWING)


READY = ["activate", "path", "odometry"]


@pytest.mark.parametrize(
    ("events", "state", "cause"),
    [
        ([], State.INACTIVE, "activated"),
        (["activate"], State.WAITING, "no path"),
        (["activate", "path"], State.WAITING, "no odometry"),
        (READY, State.FOLLOWING, ""),
        ([*READY, "long wait"], State.FAULT, "0.5 s"),
        ([*READY, "long wait", "odometry"], State.FOLLOWING, ""),
        ([*READY, "bad odometry"], State.FAULT, "pose is not finite"),
        ([*READY, "bad odometry", "odometry"], State.FAULT, "pose is not finite"),
        ([*READY, "bad odometry", "odometry", "wait", "odometry"], State.FOLLOWING, ""),
        ([*READY, *["bad odometry", "wait", "odometry"] * 3], State.FAULT, "pose is not finite"),
        ([*READY, "carried", "odometry", "wait", "odometry"], State.FAULT, "elsewhere"),
        ([*READY, "carried", "odometry", "wait", "odometry", "resume"], State.FOLLOWING, ""),
        ([*READY, "no limit", "odometry"], State.FAULT, "speed limit is 0"),
        ([*READY, "no limit", "limit"], State.FOLLOWING, ""),
        ([*READY, "stop", "renew", *READY], State.STOPPED, "~/stop"),
        ([*READY, "too far", "renew", *READY], State.FAULT, "2 m"),
        ([*READY, "refused"], State.FAULT, "command is not finite"),
        ([*READY, "refused", "odometry"], State.FOLLOWING, ""),
        ([*READY, "goal"], State.GOAL_REACHED, "end"),
        ([*READY, "goal", "path"], State.FOLLOWING, ""),
        ([*READY, "goal", "long wait"], State.FAULT, "0.5 s"),
        ([*READY, "no path"], State.WAITING, "no path"),
        ([*READY, "no clock"], State.WAITING, "/clock"),
        ([*READY, "no clock", "clock"], State.FOLLOWING, ""),
        ([*READY, "tick", "long wait", "odometry"], State.FAULT, "no control step"),
        ([*READY, "tick", "long wait", "odometry", "tick"], State.FOLLOWING, ""),
        ([*READY, "stop", "odometry", "path"], State.STOPPED, "~/stop"),
        ([*READY, "stop", "resume"], State.FOLLOWING, ""),
        ([*READY, "too far", "odometry", "path"], State.FAULT, "2 m"),
        ([*READY, "too far", "resume"], State.FOLLOWING, ""),
        ([*READY, "deactivate"], State.INACTIVE, "activated"),
    ],
)
def test_states_and_their_causes(events, state, cause):
    supervisor, now, _ = played(events)
    status = supervisor.status(now)
    assert status.state is state
    assert cause in status.cause


@pytest.mark.parametrize(
    ("error", "text"),
    [
        ((9.0, 0.4, 0.9), ""),  # s is how far the target is ahead, not off the path
        ((0.0, -0.6, 0.0), "cross-track error 0.600 m is above max_cross_track_error 0.5"),
        ((0.0, 0.0, -1.5), "heading error 1.500 rad is above max_heading_error 1"),
    ],
)
def test_how_far_from_the_path_is_too_far(error, text):
    limits = build(Settings, {"max_cross_track_error": 0.5, "max_heading_error": 1.0})
    assert deviation(np.array(error), limits.controller) == text
    assert deviation(np.array(error), build(Settings, {}).controller) == ""


def test_the_timeout_can_be_changed():
    supervisor, now, _ = played([*READY, "long wait"])
    assert supervisor.status(now).state is State.FAULT
    supervisor.odom_timeout = 2.0
    assert supervisor.status(now).state is State.FOLLOWING


@given(st.lists(st.sampled_from(EVENTS)))
@settings(max_examples=300)
def test_silence_is_a_fault_as_soon_as_patience_is_over_and_not_before(events):
    supervisor, now, _ = played(["activate", "path", "odometry", *events])
    if supervisor.status(now).state is State.FOLLOWING:
        patience = supervisor.patience(now)
        assert 0.0 <= patience <= TIMEOUT
        assert supervisor.status(now + patience - 1e-6).state is State.FOLLOWING
        assert supervisor.status(now + patience + 1e-6).state is State.FAULT
