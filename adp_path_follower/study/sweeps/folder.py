"""The folder of a sweep or a tuning; a sweep's runs are Parquet files, whole or not at all."""

import fcntl
import functools
import io
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path as FilePath
from typing import Self

import pyarrow as pa
import pyarrow.parquet as pq

from adp_path_follower import __version__
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.files import UNFINISHED, output_to, write_whole
from adp_path_follower.study.sweeps.cluster import Workers
from adp_path_follower.study.sweeps.objectives import Score, score_of_runs
from adp_path_follower.study.sweeps.request import Sweep
from adp_path_follower.study.sweeps.runs import Columns, joined, run_part

_LOCK = ".lock"


class OutputFolder:
    """A folder with a note of what it is for; what is interrupted goes on there, nothing else."""

    def __init__(self, directory: FilePath, kind: str, description: Mapping[str, object]) -> None:
        """Open the folder of a piece of work, or make it, with a note KIND.json.

        The kind is "sweep" or "tune"; the results depend on the `description`, as JSON has it.
        Raises FileError if the folder cannot be written, holds something else or results of another
        request or version, or if another command is writing there.
        """
        self.directory, self._kind = directory, kind
        self._note = directory / f"{kind}.json"
        self._description = json.loads(json.dumps(description))
        with output_to(directory):
            try:
                directory.mkdir(parents=True, exist_ok=True)
            except (FileExistsError, NotADirectoryError):
                raise FileError(f"output {directory} is a file: give a directory") from None
            self._check()
            self._lock = (directory / _LOCK).open("w")
            self._claim()
            self._check()  # again, as another command may have written between the two
            if not self._note.exists():
                content = {"version": __version__, kind: description}
                self.write(self._note, (json.dumps(content, indent=1) + "\n").encode())

    def __enter__(self) -> Self:
        """Return the folder, which no other command may use until the block ends."""
        return self

    def __exit__(self, *error: object) -> None:
        """Leave the folder to others."""
        self._lock.close()

    def write(self, file: FilePath, content: bytes) -> None:
        """Write a whole file of the folder (flushed, then renamed), or raise FileError."""
        try:
            write_whole(file, content)
        except OSError as error:
            raise FileError(
                f"output {file} cannot be written: {error.strerror}; what is there stays, and the "
                "same command goes on from it"
            ) from None

    def _claim(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise FileError(
                f"output {self.directory} is being written by another adp {self._kind}: wait for "
                "it, or give another directory"
            ) from None

    def _check(self) -> None:
        """Refuse a folder of something else."""
        if not self._note.exists():
            if any(item.name != _LOCK for item in self.directory.iterdir()):
                raise FileError(
                    f"output {self.directory} holds files of something else: give a new directory"
                )
            return
        try:
            found = json.loads(self._note.read_text(encoding="utf-8"))
            version, before = str(found["version"]), dict(found[self._kind])
        except (ValueError, KeyError, TypeError):
            raise FileError(f"file {self._note} is damaged: give a new directory") from None
        if version != __version__:
            raise FileError(
                f"output {self.directory} is of adp_path_follower {version}, but this is "
                f"{__version__}: go on with that version, or give a new directory"
            )
        now = self._description
        changed = [name for name in {**before, **now} if before.get(name) != now.get(name)]
        if changed:
            raise FileError(
                f"output {self.directory} is of another {self._kind}, which differs in "
                f"{', '.join(changed)}: give a new directory, or the file as it was"
            )


class PartsFolder(OutputFolder):
    """The folder of a sweep; each part in it is complete."""

    def __init__(self, directory: FilePath, sweep: Sweep) -> None:
        super().__init__(directory, "sweep", sweep.description())
        self.sweep = sweep
        self.runs = directory / "runs"
        with output_to(self.runs):
            self.runs.mkdir(exist_ok=True)
            for leftover in self.runs.glob(f"*{UNFINISHED}"):
                leftover.unlink()

    def file_of(self, part: int) -> FilePath:
        """Return the file of a part."""
        return self.runs / f"part-{part:07d}.parquet"

    def missing(self) -> list[int]:
        """Return the numbers of the missing parts."""
        return [part for part in range(self.sweep.parts) if not self._is_there(part)]

    def run(self, missing: list[int], workers: Workers, progress: Callable[[float], None]) -> None:
        """Run missing parts; `progress` takes the fraction done; an AdpError keeps others."""
        found = workers.results(functools.partial(run_part, self.sweep), missing)
        for done, (part, columns) in enumerate(found, start=1):
            buffer = io.BytesIO()
            pq.write_table(pa.table(columns), buffer)
            self.write(self.file_of(part), buffer.getvalue())
            progress(done / len(missing))

    def scores(self) -> Iterator[Score]:
        """Return the scores of the combinations of settings, in their order."""
        each, size = self.sweep.conditions.runs, self.sweep.conditions.part_size
        for combination in range(self.sweep.combinations):
            first, last = combination * each, (combination + 1) * each - 1
            parts = [_read(self.file_of(part)) for part in range(first // size, last // size + 1)]
            columns = joined(parts)
            own = columns["combination"] == combination
            yield score_of_runs({name: values[own] for name, values in columns.items()})

    def _is_there(self, part: int) -> bool:
        """Return whether a part of this sweep exists, with all its runs."""
        try:
            rows = pq.read_metadata(self.file_of(part)).num_rows
        except (pa.ArrowException, OSError):
            return False  # missing or damaged: these runs are repeated
        return bool(rows == len(self.sweep.runs_of(part)))


@functools.lru_cache(maxsize=1)
def _read(file: FilePath) -> Columns:
    """Return the columns of a part, which may hold many combinations, one read after the other."""
    table = pq.read_table(file)
    return {name: table.column(name).to_numpy(zero_copy_only=False) for name in table.column_names}
