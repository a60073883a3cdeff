"""Output files: what is wrong with them is one sentence, said before the work if possible."""

import contextlib
import json
import math
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path as FilePath
from typing import Any

import click
import numpy as np

from adp_path_follower.cli.options import FILE, Command
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.files import output_to, write_whole

STDOUT = FilePath("-")
_OWN_STDOUT = "adp_path_follower.stdout"


def check_figure(file: FilePath | None) -> None:
    """Raise FileError for a kind of figure that cannot be drawn, before any work is done."""
    if file is None:
        return
    from matplotlib.backend_bases import FigureCanvasBase  # which others need not wait for

    if file.suffix.lower().removeprefix(".") not in FigureCanvasBase.get_supported_filetypes():
        raise FileError(
            f"figure {file} must end in .png, .svg, .pdf or another kind of picture, as in "
            f"{file.with_suffix('.png')}"
        )


@contextlib.contextmanager
def whole_file(file: FilePath) -> Iterator[FilePath]:
    """Yield a place to write a file to, which is then there as a whole; FileError if it cannot."""
    with output_to(file), tempfile.TemporaryDirectory() as folder:
        yield FilePath(folder) / file.name
        _write_whole(file, (FilePath(folder) / file.name).read_bytes())


def write_npz(file: FilePath, arrays: dict[str, Any]) -> None:
    """Write arrays to a compressed NumPy file of exactly this name; may raise FileError."""
    with whole_file(file) as place, place.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def check_writable(*files: FilePath | None) -> None:
    """Raise FileError for output files that cannot be written, before any work is done."""
    given = [file for file in files if file not in (None, STDOUT)]
    for number, file in enumerate(given):
        if file.resolve() in [other.resolve() for other in given[:number]]:
            raise FileError(f"output {file} is given twice: give each output a file of its own")
        if file.is_dir():
            raise FileError(f"output {file} is a directory: give a file name")
        if not file.parent.is_dir():
            raise FileError(f"output {file}: there is no directory {file.parent}")
        if not os.access(file if file.exists() else file.parent, os.W_OK):
            raise FileError(f"output {file} cannot be written: permission denied")


def new_directory(directory: FilePath) -> FilePath:
    """Return an output directory, made if needed; FileError if it holds files or cannot be made."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        is_used = any(directory.iterdir())
    except (FileExistsError, NotADirectoryError):
        raise FileError(f"output {directory} is a file: give a directory") from None
    except OSError as error:
        raise FileError(f"output {directory} cannot be made: {error.strerror}") from None
    if is_used:
        raise FileError(f"output {directory} holds files already: give a new directory")
    return directory


@contextlib.contextmanager
def output_directory(directory: FilePath, keep: bool = False) -> Iterator[FilePath]:
    """Make an output directory, or `keep` its files; remove what a failing block has written.

    Raises FileError as `new_directory`, or if something in it cannot be written.
    """
    was_there = os.path.lexists(directory)  # which no name is too long for
    new_directory(directory)
    try:
        with output_to(directory):
            yield directory
    except BaseException:
        with contextlib.suppress(OSError):
            for item in () if keep else directory.iterdir():  # it was empty
                shutil.rmtree(item) if item.is_dir() else item.unlink()
            if not was_there:
                directory.rmdir()
        raise


def write_json(file: FilePath, content: object) -> None:
    """Write JSON with null for numbers that are not finite; may raise FileError."""
    text = json.dumps(_finite(content), indent=2, allow_nan=False)
    if file == STDOUT:
        click.echo(text, file=click.get_current_context().meta[_OWN_STDOUT])
        return
    with output_to(file):
        _write_whole(file, f"{text}\n".encode())


def _write_whole(file: FilePath, content: bytes) -> None:
    """Write a file as a whole or not at all, or in place where it is no file but /dev/stdout."""
    place = file.resolve()
    devices = ("/dev", "/proc", "/sys")
    if (place.exists() and not place.is_file()) or any(
        path.is_relative_to(folder) for folder in devices for path in (place, file.absolute())
    ):
        file.write_bytes(content)
    else:
        write_whole(place, content)


def json_option(meaning: str) -> Callable[[Command], Command]:
    """Add --json; "-" is standard output, where nothing else goes then."""

    def alone(ctx: click.Context, _: click.Parameter, file: FilePath | None) -> FilePath | None:
        if file == STDOUT:
            ctx.meta[_OWN_STDOUT] = sys.stdout
            ctx.with_resource(contextlib.redirect_stdout(sys.stderr))
        return file

    text = f"{meaning}; - for standard output, without anything else."
    return click.option("--json", "json_file", type=FILE, metavar="FILE", help=text, callback=alone)


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    if isinstance(content, np.ndarray | np.generic):
        return _finite(content.tolist())
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content
