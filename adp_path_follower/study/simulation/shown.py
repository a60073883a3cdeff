"""Simulated runs as a page shows them."""

from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.drive import project
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.criteria import transient
from adp_path_follower.drawing.charts import (
    Charts,
    Line,
    Panel,
    ShownRun,
    command_panels,
    line_of,
    path_line,
    track_of,
)
from adp_path_follower.study.simulation.trajectories import Trajectories
from sim_unicycle.fault_script import FaultScript

_BUCKETS = 2500  # of a curve, shared by the runs
_POINTS, _SAMPLES = 500, 6000  # of a track and of a motion, likewise


def shown_run(
    name: str,
    path: Path,
    settings: Settings,
    found: Trajectories,
    run: int = 0,
    among: int = 1,
    faults: FaultScript | None = None,
) -> ShownRun:
    """Return a run of simulated ones as a page shows it, `among` so many."""
    time, pose, beside = found.time, found.pose[run], project(path, found.pose[run])
    buckets = max(150, _BUCKETS // among)

    def line(label: str, values: FloatArray) -> Line:
        return line_of(label, time, values, buckets)

    linear, angular = line("v", found.command[run, :, 0]), line("ω", found.command[run, :, 1])
    panels = {
        "distance": (Panel("cross-track [mm]", (line("cross-track", 1e3 * beside.cross_track),)),),
        "cost": (Panel("J so far", (line("J", found.cost[run]),)),),
        "commands": command_panels(linear, angular, settings.limits),
    }
    track = track_of(
        path_line([path], among),
        time,
        pose,
        beside.cross_track,
        steady=time >= transient(float(time[-1])),
        points=max(200, _POINTS // among),
        samples=max(500, _SAMPLES // among),
    )
    halts = {"disturbed": faults.spans(float(time[-1]))} if faults and faults.entries else {}
    return ShownRun(name, Charts(track, panels, halts=halts), ())
