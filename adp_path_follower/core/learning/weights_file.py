"""Learned weights as a file, from which another run can start.

The file is numpy's .npz without pickle: a text in YAML that says what the weights belong to, and
arrays. Weights depend on the settings that state the problem and, where they change along the
path, on its curvature; not on where the path lies, so a path that was moved or turned as a whole
keeps them.
"""

import hashlib
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path as FilePath
from typing import Any

import numpy as np

from adp_path_follower.core.errors import AdpError, FileError
from adp_path_follower.core.files import parse_yaml, write_whole
from adp_path_follower.core.learning.path_learner import MODEL_SETTINGS
from adp_path_follower.core.learning.weights import LearnedWeights
from adp_path_follower.core.robot.model import RobotModel
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.core.settings.schema import Value, build, flatten, setting_fields, yaml_text

_FORMAT = "adp_path_follower weights"
_VERSION = 1
_MOST_BYTES = 2**28
_GROUPS = ("target", "cost", "limits")  # of settings that state the problem
_BASIS = ("basis", "basis_degree", "frame", "scheduling")
_ARRAYS = {"knots": "<i8", "curvature": "<f8", "speed": "<f8", "critic": "<f8", "actor": "<f8"}
_AGAIN = "save it again with ~/save_weights, or leave 'weights_file' empty"


@dataclass(frozen=True)
class SavedWeights:
    """Learned weights, and the settings that they belong to."""

    settings: Mapping[str, Value]  # setting -> value, of those that state the problem
    learned: LearnedWeights  # the weights
    digest: str = ""  # hash of the file, empty before there is one
    robot: tuple[float, ...] = ()  # parameters of the learned `RobotModel`, empty without one


def problem_settings(settings: Settings) -> dict[str, Value]:
    """Return the settings that decide the weights, name: value."""
    along_path = settings.learning.scheduling == "arc_length"
    names = {*_BASIS, *(MODEL_SETTINGS if along_path else ())}
    names |= {field.name for field in setting_fields(Settings) if field.group in _GROUPS}
    return {name: value for name, value in flatten(settings).items() if name in names}


def difference(saved: SavedWeights, settings: Settings) -> str:
    """Return how settings state another problem than saved weights solve, empty if they do not."""
    for name, value in problem_settings(settings).items():
        learned_with = saved.settings.get(name)
        if learned_with != value:
            said = "without" if learned_with is None else f"with {name} {yaml_text(learned_with)},"
            return f"learned {said} where '{name}' is {yaml_text(value)} now"
    return ""


def encode(saved: SavedWeights) -> bytes:
    """Return the content of a weights file; raise FileError if weights are not finite."""
    learned = saved.learned
    if not (np.isfinite(learned.critic).all() and np.isfinite(learned.actor).all()):
        raise FileError("the weights are not finite: call ~/reset_learning and learn again")
    lines = [f"format: {_FORMAT}", f"version: {_VERSION}"]
    lines += [f"length: {yaml_text(learned.length)}", f"closed: {yaml_text(learned.closed)}"]
    lines += [f"reach: {learned.reach}", f"robot: {yaml_text(saved.robot)}", "settings:"]
    lines += [f"  {name}: {yaml_text(value)}" for name, value in saved.settings.items()]
    content = io.BytesIO()
    arrays = {name: getattr(learned, name).astype(kind) for name, kind in _ARRAYS.items()}
    head = np.frombuffer("\n".join(lines).encode(), np.uint8)
    np.savez(content, head=head, **arrays)
    return content.getvalue()


def decode(content: bytes, name: str) -> SavedWeights:
    """Return the weights in the content of a weights file; FileError, with `name`, if unsound."""
    head: object = None
    try:
        with np.load(io.BytesIO(content)) as archive:
            if sum(member.file_size for member in archive.zip.infolist()) <= _MOST_BYTES:
                parts = {array: archive[array] for array in _ARRAYS}
                head = parse_yaml(archive["head"].tobytes().decode())
    except Exception:  # the libraries raise anything for damaged bytes
        head = None
    if not isinstance(head, dict) or head.get("format") != _FORMAT:
        raise FileError(f"{name} is no weights file, or is damaged: {_AGAIN}")
    if head.get("version") != _VERSION:
        raise FileError(
            f"{name} has version {head.get('version')!r} of the format, but this package reads "
            f"version {_VERSION}: {_AGAIN}"
        )
    try:
        settings = _checked_settings(head.get("settings"))
        learned = _checked(head, parts, len(settings.learning.value_basis.labels))
        robot = _checked_robot(head.get("robot", []))
    except AdpError as damage:
        raise FileError(f"{name} cannot be used, {damage}: {_AGAIN}") from None
    digest = hashlib.sha256(content).hexdigest()[:16]
    return SavedWeights(problem_settings(settings), learned, digest, robot)


def read_weights(file: FilePath, settings: Settings) -> tuple[SavedWeights, bytes]:
    """Return a file's weights and content; FileError if unsound, or learned for other settings."""
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise FileError(f"weights file {file} is too large to be one: {_AGAIN}")
        content = file.read_bytes()
    except FileError:
        raise
    except OSError as error:
        raise FileError(
            f"weights file {file} cannot be read: {error.strerror}; give a file that "
            "~/save_weights wrote, or leave 'weights_file' empty"
        ) from None
    except ValueError as error:  # a name that no file can have
        raise FileError(f"weights file {str(file)!r} cannot be read: {error}") from None
    saved = decode(content, f"weights file {file}")
    other = difference(saved, settings)
    if other:
        raise FileError(
            f"weights file {file} belongs to other settings: {other}; give the settings that it "
            "was learned with, or leave 'weights_file' empty"
        )
    return saved, content


def write_weights(file: FilePath, content: bytes) -> None:
    """Write a weights file as a whole or not at all; raise FileError if it cannot be written."""
    try:
        write_whole(file, content)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise FileError(
            f"weights file {file} cannot be written: {reason}; set 'save_weights_to' to a file in "
            "a directory that exists and can be written"
        ) from None


def _checked_settings(values: Any) -> Settings:
    """Return the settings that a file names, the others at their defaults."""
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise FileError("as it names no settings")
    settings = build(Settings, values)
    for name in problem_settings(settings):
        if name not in values:
            raise FileError(f"as it does not say which '{name}' its weights belong to")
    return settings


def _checked_robot(values: Any) -> tuple[float, ...]:
    """Return the parameters of a robot's model, none where none was learned."""
    if values == []:
        return ()
    numbers = isinstance(values, list) and all(isinstance(value, float) for value in values)
    if not numbers or len(values) != len(fields(RobotModel)) or not RobotModel(*values).possible:
        raise FileError("as its robot is none")
    return tuple(values)


def _checked(
    head: Mapping[str, Any], arrays: Mapping[str, np.ndarray], size: int
) -> LearnedWeights:
    """Return the weights of a basis with so many terms."""
    length, closed, reach = head.get("length"), head.get("closed"), head.get("reach")
    if not isinstance(length, float) or not 0.0 < length < math.inf:
        raise FileError("as it does not say how long its path is")
    if not isinstance(closed, bool) or type(reach) is not int or not 0 <= reach <= 10**6:
        raise FileError("as it does not say what its path is")
    count = arrays["knots"].shape[0] if arrays["knots"].ndim == 1 else -1
    shapes = {"knots": (count,), "curvature": (count,), "speed": (count,)}
    for name, kind in _ARRAYS.items():
        array, shape = arrays[name], shapes.get(name, (count, size))
        if array.shape != shape or array.dtype != np.dtype(kind):
            raise FileError(
                f"as its '{name}' has the shape {array.shape} and the type {array.dtype}, not "
                f"{shape} and {np.dtype(kind)}"
            )
        if not np.isfinite(array).all():
            raise FileError(f"as its '{name}' is not finite")
    if not (np.diff(arrays["knots"]) > 0).all() or np.abs(arrays["knots"]).max(initial=0) > 10**12:
        raise FileError("as its 'knots' do not rise")
    return LearnedWeights(
        length=length, closed=closed, reach=reach, **{name: arrays[name] for name in _ARRAYS}
    )
