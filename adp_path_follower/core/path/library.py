"""Built-in paths and path files: one name for a path everywhere.

A path is named ``lissajous`` (the paper's figure eight), ``line``, ``identify`` (a short slalom
that excites all that `adp identify` looks for), ``circle:KAPPA`` with the signed curvature in 1/m,
or by a CSV or YAML file.
"""

import contextlib
import difflib
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path as FilePath

import numpy as np

from adp_path_follower.core.errors import FileError, PathError
from adp_path_follower.core.files import expanded, read_csv_columns, read_yaml
from adp_path_follower.core.geometry import FloatArray
from adp_path_follower.core.path.curve import Path
from adp_path_follower.core.path.points import distinct_points, joined
from adp_path_follower.core.path.route import Route, route_of
from adp_path_follower.core.settings.groups import PathSettings

PATH_HELP = (
    "lissajous (the paper's figure eight), line, identify (a short slalom for adp identify), "
    "circle:KAPPA (curvature in 1/m, positive to the left), or a file: CSV with columns x,y or "
    "YAML with 'points: [[x, y], ...]'"
)
_HEADINGS = ("th", "theta", "yaw", "heading")  # columns of which a file may have one
_TINY = 0.01  # [m]
_FITS = 0.7  # mean cosine between headings and motion
_LINE_LENGTH = 100.0  # [m]


def named_path(name: str, settings: PathSettings | None = None) -> Path:
    """Return the path of this name; see the module's docstring.

    The settings prepare the points of a file, the defaults if None. A path that turns back is
    rejected: only the controller drives backwards. Raises PathError for an unknown name or points
    that make no path, FileError for a file that is missing or of another format.
    """
    if name == "lissajous":
        return lissajous()
    if name == "line":
        return Path.from_points([[0.0, 0.0], [_LINE_LENGTH, 0.0]], closed=False)
    if name == "identify":
        return slalom()
    if name.startswith("circle:"):
        return circle(_curvature(name))
    if is_path_file(name):
        return path_from_file(expanded(name), settings)
    meant = difflib.get_close_matches(name, ("lissajous", "line", "identify", "circle:"), 1)
    if name.partition(":")[0] in difflib.get_close_matches("circle", [name.partition(":")[0]]):
        meant = [f"circle:{name.partition(':')[2] or 'KAPPA'}"]
    hint = f", did you mean '{meant[0]}'?" if meant else ":"
    raise PathError(f"unknown path '{name}'{hint} use {PATH_HELP}")


def lissajous() -> Path:
    """Return the paper's figure eight x = 10 sin p, y = 15 sin 2p by arc length (130.975 m)."""
    return Path.from_curve(
        lambda p: np.stack([10.0 * np.sin(p), 15.0 * np.sin(2.0 * p)], axis=-1),
        lambda p: np.stack([10.0 * np.cos(p), 30.0 * np.cos(2.0 * p)], axis=-1),
        np.linspace(0.0, 2.0 * math.pi, 401),
        closed=True,
    )


def slalom() -> Path:
    """Return 12 m along +x with ever shorter swings of up to 0.25 m, straight at both ends."""
    x = np.linspace(0.0, 12.0, 601)
    swing = np.clip((x - 2.0) / 8.0, 0.0, 1.0)
    phase = 2.8 * math.pi * (1.6 * swing + 0.9 * swing**2)
    envelope = np.sin(math.pi * swing) ** 2
    return Path.from_points(np.column_stack([x, 0.25 * envelope * np.sin(phase)]), closed=False)


def _curvature(name: str) -> float:
    """Return the curvature [1/m] of a name like "circle:0.5"."""
    text = name.removeprefix("circle:")
    try:
        curvature = float(text)
    except ValueError:
        curvature = math.nan
    if not 1e-4 <= abs(curvature) <= 1e4:
        raise PathError(
            f"circle has curvature '{text}', but must have a number between 1e-4 and 1e4 1/m, "
            "negative for a turn to the right, as in circle:0.5"
        )
    return curvature


def circle(curvature: float) -> Path:
    """Return the circle of a signed curvature [1/m] that leaves the origin along +x."""
    return Path.from_curve(
        lambda s: (
            np.stack([np.sin(curvature * s), 1.0 - np.cos(curvature * s)], axis=-1) / curvature
        ),
        lambda s: np.stack([np.cos(curvature * s), np.sin(curvature * s)], axis=-1),
        np.linspace(0.0, 2.0 * math.pi / abs(curvature), 101),
        closed=True,
    )


def path_from_file(file: FilePath, settings: PathSettings | None = None) -> Path:
    """Return the path along a file's points; FileError if it is unsound, PathError for no path."""
    poses, closed = read_poses(file)
    with _errors_in(file):
        return path_through(poses[:, :2], closed, settings)


def named_route(name: str, settings: PathSettings) -> Route:
    """Return a name's route as the controller drives it, also backwards; errors as `named_path`."""
    from adp_path_follower.core.path.preparation import prepare  # as below

    if not is_path_file(name):
        return route_of(named_path(name))
    file = expanded(name)
    poses, closed = read_poses(file)
    with _errors_in(file):
        return prepare(poses[:, :2], settings, poses[:, 2], closed)


def path_through(
    points: FloatArray, closed: bool | None, settings: PathSettings | None = None
) -> Path:
    """Return the path along points (N, 2) [m]; PathError if they make none."""
    # Commands that prepare no path need not wait for scipy's splines, half of their start.
    from adp_path_follower.core.path.preparation import prepare

    forwards = replace(settings or PathSettings(), allow_reversing=False)
    return prepare(points, forwards, closed=closed).segments[0].path


def named_points(name: str, spacing: float) -> FloatArray:
    """Return poses to publish for a name: x, y, heading, (N, 3); errors as `named_path`.

    Those of a built-in path are at most `spacing` [m] apart. Those of a file may have no heading
    (NaN), and the last pose comes twice if it says `closed: false`.
    """
    if not is_path_file(name):
        return named_path(name).points(spacing)
    file = expanded(name)
    poses, closed = read_poses(file)
    with _errors_in(file):
        distinct, kept = distinct_points(poses[:, :2])
        distinct, _ = joined(distinct, closed)
    if closed is None and np.isfinite(poses[:, 2:]).any():
        return poses  # several in one place are a turn on the spot
    headings = poses[np.append(kept, kept[:1])[: len(distinct)], 2]
    found = np.column_stack([distinct, headings])
    return found if closed is not False else np.vstack([found, found[-1:]])


def is_path_file(name: str) -> bool:
    """Return whether a name is that of a path file."""
    return FilePath(name).suffix.lower() in (".csv", ".yaml", ".yml")


@contextlib.contextmanager
def _errors_in(file: FilePath) -> Iterator[None]:
    """Name the file in a PathError of the block."""
    try:
        yield
    except PathError as error:
        raise PathError(f"path file {file}: {error}") from None


def read_poses(file: FilePath) -> tuple[FloatArray, bool | None]:
    """Return the poses of a path file, shape (N, 3), and whether it says that it is closed.

    Headings are NaN where it has none. Raises FileError if it is missing or of another format,
    PathError if its points are no list of x and y.
    """
    if file.suffix.lower() == ".csv":
        poses = read_csv_columns(file, ("x", "y"), _HEADINGS)
        _check_units(file, poses)
        return poses, None
    content = read_yaml(file)
    if not isinstance(content, dict) or "points" not in content:
        raise FileError(f"path file {file} has no 'points: [[x, y], ...]'")
    closed = content.get("closed")
    if closed is not None and not isinstance(closed, bool):
        raise FileError(f"path file {file} has 'closed: {closed}', but must be true or false")
    try:
        points = np.asarray(content["points"], dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise FileError(f"path file {file} has 'points' that are not [x, y] pairs") from None
    if points.ndim != 2 or points.shape[1] < 2:
        raise PathError(
            f"path file {file}: path has shape {points.shape}, but must be a list of x, y"
        )
    return np.column_stack([points[:, :2], np.full(len(points), np.nan)]), closed


def _check_units(file: FilePath, poses: FloatArray) -> None:
    """Raise FileError if poses (N, 3) are degrees: of latitude and longitude, or headings."""
    size = np.ptp(poses[:, :2], axis=0).max()
    if 0.0 < size < _TINY:
        raise FileError(f"file {file} has a path of {size:.2g} m across: are its columns metres?")
    headings = poses[:-1, 2]
    if not np.abs(headings).max(initial=0.0) > math.tau:  # as none is where there are no headings
        return
    motion = np.arctan2(*np.diff(poses[:, :2], axis=0).T[::-1])
    as_told, as_degrees = (
        np.cos(item - motion).mean() for item in (headings, np.radians(headings))
    )
    if as_told < _FITS < as_degrees:
        raise FileError(f"file {file} has headings in degrees: name their column yaw_deg")
