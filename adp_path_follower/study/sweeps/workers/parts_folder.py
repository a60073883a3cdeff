"""The results of a sweep as Parquet files, each written as a whole or not at all."""

import io
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path as FilePath

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from adp_path_follower.core.errors import FileError
from adp_path_follower.study.sweeps.workers.cluster import Workers
from adp_path_follower.study.sweeps.workers.output_folder import UNFINISHED, OutputFolder
from adp_path_follower.study.sweeps.workers.plan import Plan, work_off
from adp_path_follower.study.sweeps.workers.runs import Columns, joined

_MARK = b"adp_sweep"  # key of the sweep's digest in each file


class PartsFolder(OutputFolder):
    """The folder of a sweep; each part in it is complete."""

    def __init__(self, directory: FilePath, plan: Plan) -> None:
        """Open the folder of a sweep, or make it; raises as `OutputFolder` does."""
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
        """Run missing parts and write each one; `progress` takes the fraction done.

        Raises AdpError if folder or workers fail; finished parts stay.
        """
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
