"""A file that a thread writes, so that a slow disk delays no recording."""

import contextlib
import os
import threading
from collections import deque
from pathlib import Path as FilePath

_BATCH = 256 * 1024  # [bytes] that are handed to the thread without being asked
_MOST_WAITING = 64 * 1024 * 1024  # [bytes]; beyond it the disk sets the pace, as memory is bounded


class BackgroundFile:
    """A new file to append to.

    Each piece that is given to `write` is whole or missing in the file: where the disk is full, the
    file is cut behind the last piece that fits. The rest waits for another attempt by `close`.
    """

    def __init__(self, path: FilePath) -> None:
        """Create the file and start its thread; OSError if it exists or cannot be made."""
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
        self._descriptor = os.open(path, flags, 0o666)
        self._length = 0  # of all that was given
        self._written = 0
        self._batch: list[bytes] = []
        self._batch_bytes = 0
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._error: OSError | None = None
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=path.name, daemon=True)
        self._thread.start()

    @property
    def is_settled(self) -> bool:
        """Return whether the thread has ended: `close` does not wait for it."""
        return not self._thread.is_alive()

    def tell(self) -> int:
        """Return the length [bytes] of all that was given, written or not."""
        return self._length

    def write(self, piece: bytes) -> int:
        """Take a piece; it is lost if the process is killed before `flush`."""
        self._batch.append(piece)
        self._length += len(piece)
        self._batch_bytes += len(piece)
        if self._batch_bytes >= _BATCH:
            self._hand_over()
        return len(piece)

    def flush(self) -> None:
        """Have everything written at once, by the thread; OSError if an earlier piece failed."""
        self._hand_over()
        if self._error is not None:
            raise self._error

    def end(self) -> None:
        """Have the thread write everything and end."""
        self._hand_over()
        with self._changed:
            self._closing = True
            self._changed.notify_all()

    def close(self) -> None:
        """Write everything, with another attempt at what failed, and close; may raise OSError."""
        self.end()
        self._thread.join()
        try:
            self._write_waiting()
        finally:
            os.close(self._descriptor)

    def _hand_over(self) -> None:
        with self._changed:
            self._changed.wait_for(
                lambda: self._waiting_bytes < _MOST_WAITING or self._error is not None
            )
            self._waiting.extend(self._batch)
            self._waiting_bytes += self._batch_bytes
            self._changed.notify_all()
        self._batch = []
        self._batch_bytes = 0

    def _run(self) -> None:
        """Write what comes until the end, or until the first error."""
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._waiting or self._closing)
                    if not self._waiting:
                        return
                self._write_waiting()
        except OSError as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _write_waiting(self) -> None:
        """Write all pieces that wait, or as many as there is room for."""
        with self._changed:
            pieces = list(self._waiting)
        data = memoryview(b"".join(pieces))
        done = 0
        try:
            while done < len(data):
                done += os.write(self._descriptor, data[done:])
        except OSError:
            self._forget(pieces, done)
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self._written)
            raise
        self._forget(pieces, done)

    def _forget(self, pieces: list[bytes], done: int) -> None:
        """Take the pieces that fit in the bytes that were written from those that wait."""
        with self._changed:
            for piece in pieces:
                if len(piece) > done:
                    break
                done -= len(piece)
                self._written += len(piece)
                self._waiting_bytes -= len(piece)
                self._waiting.popleft()
            self._changed.notify_all()
