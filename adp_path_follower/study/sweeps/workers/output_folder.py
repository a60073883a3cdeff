"""The folder of a long piece of work: of that work only, written by one command at a time."""

import fcntl
import json
from collections.abc import Mapping
from pathlib import Path as FilePath
from types import TracebackType
from typing import Self

from adp_path_follower import __version__
from adp_path_follower.core.errors import FileError
from adp_path_follower.core.files import write_whole

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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
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
