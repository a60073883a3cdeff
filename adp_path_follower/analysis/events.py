"""Events of a run: state changes, faults, parameter changes."""

from collections.abc import Sequence

from adp_path_follower.analysis.recorded_run import Drive, controller_states
from adp_path_follower.core.errors import FileError
from adp_path_follower.drawing.charts import Event
from adp_path_follower.messages.configuration import Configuration, parse_configuration

MOST_EVENTS = 500  # that are kept of a bag
_FIRST_KEPT = ("fault", "state", "parameter", "warning", "path")  # where there are too many
_ERROR = 2  # level of diagnostics


def events_of(drive: Drive) -> tuple[tuple[Event, ...], str]:
    """Return what happened, in order of time, and a note on what is left out of it, if anything."""
    run = drive.run
    states = controller_states(run.diagnostics)
    events = [
        Event(drive.seconds(item.time), "fault" if item.level >= _ERROR else "state", item.message)
        for item in states
    ]
    # Other nodes, and a new cause of the same state, count only if something is wrong.
    events += [
        Event(
            drive.seconds(item.time),
            "fault" if item.level >= _ERROR else "warning",
            f"{item.name}: {item.message}",
        )
        for item in run.diagnostics
        if item.level > 0 and item not in states
    ]
    events += [
        Event(drive.seconds(time), "path", f"path of {len(points)} points")
        for time, points in run.paths
    ]
    events += _changes(drive)
    return thinned(sorted(events, key=lambda event: event.time))


def thinned(events: Sequence[Event]) -> tuple[tuple[Event, ...], str]:
    """Return at most `MOST_EVENTS` of the events, and a note on how many of which kind are not.

    The kinds that matter most come first: a planner that sends many paths must not hide a fault.
    """
    kept: list[int] = []
    left_out = []
    for kind in _FIRST_KEPT:
        places = [place for place, event in enumerate(events) if event.kind == kind]
        room = MOST_EVENTS - len(kept)
        if len(places) > room:
            left_out.append(f"{len(places) - room} of {len(places)} {kind} events")
            places = [places[index * len(places) // room] for index in range(room)]
        kept += places
    note = f"{', '.join(left_out)} are left out of figure and list" if left_out else ""
    return tuple(events[place] for place in sorted(kept)), note


def _changes(drive: Drive) -> list[Event]:
    """Return the changes of parameters, and the resets of learning."""
    events: list[Event] = []
    before: Configuration | None = None
    for arrival, text in drive.run.configurations:
        try:
            after = parse_configuration(text)
        except FileError:  # the drive has a note about it
            continue
        if before is not None:
            time = drive.seconds(arrival)
            events += [
                Event(time, "parameter", f"{name}: {before.values.get(name)} → {value}")
                for name, value in after.values.items()
                if before.values.get(name) != value
            ]
            if after.counts.learning_resets > before.counts.learning_resets:
                events.append(Event(time, "parameter", "learning was reset"))
        before = after
    return events
