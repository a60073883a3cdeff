"""What happened during a run: state changes, faults, parameter changes."""

from __future__ import annotations

from dataclasses import dataclass

import yaml

from adp_path_follower.analysis.drive import Drive, controller_states
from adp_path_follower.core.files import parse_yaml

MOST_EVENTS = 500  # that are kept of a bag
KINDS = ("state", "fault", "warning", "parameter", "path")
_ERROR = 2  # level of diagnostics


@dataclass(frozen=True)
class Event:
    """Something that happened at a time [s]; the kind is one of `KINDS`."""

    time: float
    kind: str
    text: str


def events_of(drive: Drive) -> tuple[Event, ...]:
    """Return what happened, in order of time; at most `MOST_EVENTS`."""
    run = drive.run
    states = controller_states(run.diagnostics)
    events = [
        Event(drive.seconds(item.time), "fault" if item.level >= _ERROR else "state", item.message)
        for item in states
    ]
    # Of others, and of a state's new cause: only what is wrong.
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
    before: dict[str, object] | None = None
    for time, text in run.configurations:
        settings = _settings_of(text)
        if before is not None:
            events += [
                Event(drive.seconds(time), "parameter", f"{name}: {before.get(name)} → {value}")
                for name, value in settings.items()
                if before.get(name) != value
            ]
        before = settings
    return tuple(sorted(events, key=lambda event: event.time)[:MOST_EVENTS])


def _settings_of(text: str) -> dict[str, object]:
    """Return the settings that a configuration names; none where it is not one."""
    try:
        content = parse_yaml(text)
    except yaml.YAMLError:
        return {}
    settings = content.get("settings") if isinstance(content, dict) else None
    return (
        {str(name): value for name, value in settings.items()} if isinstance(settings, dict) else {}
    )
