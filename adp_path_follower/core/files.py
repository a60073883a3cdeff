"""Files: read with errors that name file, line and remedy, and written whole or not at all."""

import contextlib
import csv
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import yaml

from adp_path_follower.core.errors import AdpError, FileError
from adp_path_follower.core.geometry import FloatArray

UNFINISHED = ".unfinished"  # ends the names of files that are being written
_UNITS = {"": 1.0, "m": 1.0, "km": 1e3, "cm": 1e-2, "mm": 1e-3, "rad": 1.0, "deg": math.pi / 180}


# libyaml reads ten times as fast; before 0.2.6 a deep nesting overflows its stack.
_has_libyaml = yaml.__with_libyaml__ and yaml._yaml.get_version() >= (0, 2, 6)
_Loader: Any = yaml.CSafeLoader if _has_libyaml else yaml.SafeLoader


class _TwiceError(yaml.constructor.ConstructorError):
    """Report a name that a mapping has twice: which of the two values is meant?"""


class _Yaml(_Loader):  # type: ignore[misc]  # either has the same interface
    """Safe YAML that reads 1e-3 as a number, as ROS does and YAML 1.1 does not."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping whose names are all different."""
        if isinstance(node, yaml.MappingNode):
            names: set[tuple[str, str]] = set()
            for key, _ in node.value:
                name = (key.tag, key.value) if isinstance(key, yaml.ScalarNode) else None
                if name in names:
                    problem = f"'{key.value}' is there twice"
                    raise _TwiceError(problem=problem, problem_mark=key.start_mark)
                if name is not None:
                    names.add(name)
        found: dict[Any, Any] = super().construct_mapping(node, deep)
        return found


_Yaml.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"^[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
)


def expanded(name: str) -> FilePath:
    """Return the file of a name with ~ for a home; raise FileError if there is no such home."""
    try:
        return FilePath(name).expanduser()
    except RuntimeError:
        home = name.partition("/")[0]
        raise FileError(f"file {name} cannot be found: '{home}' is nobody's home") from None


def read_text(file: FilePath) -> str:
    """Return the content of a text file; raise FileError if it is missing, empty, or binary."""
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise FileError(f"file {file} is not text: give a text file in UTF-8") from None
    except OSError as error:
        raise FileError(f"file {file} cannot be read: {error.strerror}") from None
    except ValueError as error:  # a name that no file can have
        raise FileError(f"file {str(file)!r} cannot be read: {error}") from None
    if not text.strip():
        raise FileError(f"file {file} is empty")
    if "\0" in text:
        raise FileError(f"file {file} is not text: it holds a NUL byte")
    return text


def write_whole(file: FilePath, content: bytes) -> None:
    """Write a whole file, or none, whatever happens; OSError, or ValueError for a wrong name."""
    # First under another name in the same folder, which is then renamed.
    unfinished = file.with_name(f".{file.name}.{os.getpid()}{UNFINISHED}")
    try:
        with unfinished.open("wb") as output:
            output.write(content)
            output.flush()
            os.fsync(output.fileno())
        unfinished.replace(file)
    finally:
        unfinished.unlink(missing_ok=True)


@contextlib.contextmanager
def output_to(output: FilePath) -> Iterator[None]:
    """Turn an OSError of the block into a FileError: a sentence why an output cannot be written."""
    try:
        yield
    except (AdpError, BrokenPipeError):
        raise
    except OSError as error:
        reason = error.strerror or str(error)
        raise FileError(f"output {output} cannot be written: {reason}") from None


def write_output(file: FilePath, text: str) -> None:
    """Write a text file as a whole or not at all; raise FileError if it cannot be written."""
    with output_to(file):
        write_whole(file, text.encode())


def parse_yaml(text: str) -> object:
    """Return the value of a YAML text; yaml.YAMLError also for impossible values (a 13th month)."""
    try:
        return yaml.load(text, Loader=_Yaml)  # noqa: S506  # _Yaml is a SafeLoader
    except yaml.YAMLError:
        raise
    except (ArithmeticError, AttributeError, LookupError, RecursionError, ValueError) as error:
        raise yaml.YAMLError(str(error)) from None


def read_csv_columns(
    file: FilePath, columns: tuple[str, ...], optional: tuple[str, ...] = ()
) -> FloatArray:
    """Return named columns of a CSV file in SI units, shape (rows, columns).

    Names may have a unit, as in x_m or "y [mm]". The header may begin with #, as comments before it
    and below do, and lines may be blank; if it has semicolons, tabs or only spaces, they separate,
    and numbers may have a decimal comma. One more column is the first of the optional ones that the
    file has, NaN without.

    Raises FileError if the file is missing or empty, lacks a column or has it twice, or holds
    something that is not a number; the message names the line.
    """
    lines = read_text(file).splitlines()
    number = 0
    while number < len(lines) - 1 and lines[number].lstrip()[:1] in ("", "#"):
        if set(columns) <= {name for name, _ in _csv_header(lines[number])}:
            break
        number += 1
    separator, header = _separator(lines[number]), _csv_header(lines[number])
    names = [name for name, _ in header]
    chosen = [*columns, *[name for name in optional if name in names][:1]]
    wrong = next((name for name in chosen if names.count(name) != 1), None)
    if wrong is not None:
        has = f"{names.count(wrong)} columns" if wrong in names else "no column"
        raise FileError(f"file {file} has {has} '{wrong}': {_remedy(columns, names)}")
    places = [names.index(name) for name in chosen]
    try:
        rows = list(csv.reader(lines[number + 1 :], delimiter=separator, skipinitialspace=True))
    except csv.Error as error:
        raise FileError(f"file {file} is not CSV: {error}") from None
    values = []
    for line, row in enumerate(rows, start=number + 2):
        if not any(map(str.strip, row)) or row[0].lstrip().startswith("#"):
            continue
        cells = row if separator == "," else [cell.replace(",", ".") for cell in row]
        try:
            values.append([float(cells[place]) * header[place][1] for place in places])
        except (IndexError, ValueError):
            raise FileError(
                f"file {file}, line {line}: '{separator.join(row)[:60]}' is not {len(chosen)} "
                "numbers"
            ) from None
    if not values:
        raise FileError(f"file {file} has no rows below its header")
    found = np.array(values)
    if optional and len(chosen) == len(columns):
        found = np.column_stack([found, np.full(len(found), np.nan)])
    return found


def _separator(header: str) -> str:
    return next((mark for mark in ";\t," if mark in header), " ")


def _csv_header(line: str) -> list[tuple[str, float]]:
    """Return name and factor to SI units of each column that a header names."""
    found: list[tuple[str, float]] = []
    for text in line.strip().lstrip("# ").lower().split(_separator(line.strip())):
        name, _, unit = re.sub(r"[\[\]()]", " ", text.strip().strip('"')).strip().rpartition(" ")
        if not name:
            name, _, unit = unit.rpartition("_")
        if unit not in _UNITS:
            name, unit = text.strip().strip('"'), ""
        found.append((name.strip(" _"), _UNITS[unit]))
    return found


def _remedy(columns: tuple[str, ...], names: list[str]) -> str:
    """Return what the header should name where it has other names."""
    if any(name.startswith("lat") for name in names) and "x" in columns:
        return "convert latitude and longitude to metres in a plane, as by UTM, and name them x,y"
    return f"its first line must name {','.join(columns)} once, with units such as x_cm or none"


def read_yaml(file: FilePath) -> object:
    """Return the content of a YAML file; FileError if it is missing, empty or not sound YAML."""
    try:
        text = read_text(file)
        content = parse_yaml(text)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        # libyaml finds the end of a file, where a bracket is still open, a line behind the last.
        place = f", line {min(mark.line, text.count(chr(10))) + 1}" if mark else ""
        problem = error.problem if isinstance(error, _TwiceError) else "not YAML"
        raise FileError(f"file {file}{place}: {problem}") from None
    if content is None:
        raise FileError(f"file {file} is empty")
    return content
