"""The results of a sweep as Parquet files, each written as a whole or not at all."""

import fcntl
import io
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path as FilePath
from typing import Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from adp_path_follower import __version__
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.files import write_whole
from adp_path_follower.study.sweeps.workers.cluster import Workers
from adp_path_follower.study.sweeps.workers.plan import Plan, work_off
from adp_path_follower.study.sweeps.workers.runs import Columns, joined

_MARK = b"adp_sweep"  # key of the sweep's digest in each file
UNFINISHED = ".unfinished"  # ends the names of files that are being written
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
        try:
            directory.mkdir(parents=True, exist_ok=True)
            self._check()
            self._lock = (directory / _LOCK).open("w")
            self._claim()
            self._check()  # again, as another command may have written between the two
            if not self._note.exists():
                content = {"version": __version__, kind: description}
                self.write(self._note, (json.dumps(content, indent=1) + "\n").encode())
        except (FileExistsError, NotADirectoryError):
            raise FileError(f"output {directory} is a file: give a directory") from None
        except FileError:
            raise
        except OSError as error:
            raise FileError(f"output {directory} cannot be written: {error.strerror}") from None

    def __enter__(self) -> Self:
        """Return the folder, which no other command may use until the block ends."""
        return self

    def __exit__(self, *error: object) -> None:
        """Leave the folder to others."""
        self._lock.close()

    def write(self, file: FilePath, content: bytes) -> None:
        """Write a whole file of the folder (flushed, then renamed), or raise FileError."""
        try:
            write_whole(file, content, file.with_suffix(UNFINISHED))
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

    def __init__(self, directory: FilePath, plan: Plan) -> None:
        """Open or make a folder with a note KIND.json, "sweep" or "tune", of the `description`.

        Raises FileError if it cannot be written, holds other work, or another command writes there.
        """
        super().__init__(directory, "sweep", plan.sweep.description())
        self.plan = plan
        self._digest = plan.sweep.digest.encode()
        self.runs = directory / "runs"
        try:
            self.runs.mkdir(exist_ok=True)
            for leftover in self.runs.glob(f"*{UNFINISHED}"):
                leftover.unlink()
        except OSError as error:
            raise FileError(f"output {self.runs} cannot be written: {error.strerror}") from None

    def file_of(self, part: int) -> FilePath:
        """Return the file of a part."""
        return self.runs / f"part-{part:07d}.parquet"

    def missing(self) -> list[int]:
        """Return the numbers of the missing parts."""
        return [part for part in range(self.plan.parts) if not self._is_there(part)]

    def run(self, missing: list[int], workers: Workers, progress: Callable[[float], None]) -> None:
        """Run missing parts; `progress` takes the fraction done; an AdpError keeps others."""
        parts = (self.plan.part(number) for number in missing)
        for done, (part, columns) in enumerate(workers.results(work_off, parts), start=1):
            self.add(part.number, columns)
            progress(done / len(missing))

    def add(self, part: int, columns: Columns) -> None:
        """Write a part; raise FileError if it cannot be written."""
        table = pa.table({name: _array(values) for name, values in columns.items()})
        buffer = io.BytesIO()
        pq.write_table(table.replace_schema_metadata({_MARK: self._digest}), buffer)
        self.write(self.file_of(part), buffer.getvalue())

    def read(self, part: int) -> Columns:
        """Return a part: column name -> values."""
        table = pq.read_table(self.file_of(part))
        return {
            name: table.column(name).to_numpy(zero_copy_only=False) for name in table.column_names
        }

    def combinations(self) -> Iterator[Columns]:
        """Return the runs of each combination of settings, one combination after the other."""
        pending: list[Columns] = []
        for part in range(self.plan.parts):
            columns = self.read(part)
            bounds = np.flatnonzero(np.diff(columns["combination"])) + 1
            for first, last in itertools.pairwise([0, *bounds.tolist(), len(columns["run"])]):
                some = {name: values[first:last] for name, values in columns.items()}
                if pending and pending[0]["combination"][0] != some["combination"][0]:
                    yield joined(pending)
                    pending = []
                pending.append(some)
        if pending:
            yield joined(pending)

    def _is_there(self, part: int) -> bool:
        """Return whether a part of this sweep exists, with all its runs."""
        file = self.file_of(part)
        if not file.exists():
            return False
        try:
            metadata = pq.read_metadata(file)
        except (pa.ArrowException, OSError):
            return False  # damaged: these runs are repeated
        expected = len(self.plan.runs_of(part))
        mark = (metadata.metadata or {}).get(_MARK)
        return bool(metadata.num_rows == expected and mark == self._digest)


def _array(values: np.ndarray) -> pa.Array:
    return pa.array(values.tolist(), pa.string()) if values.dtype == object else pa.array(values)
