"""Workers on all cores of this machine, or on an existing Dask cluster."""

import contextlib
import logging
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from typing import Any, TypeVar

from distributed import Client, LocalCluster
from distributed.comm.addressing import parse_address, parse_host_port
from distributed.scheduler import KilledWorker
from distributed.security import Security

from adp_path_follower import __version__
from adp_path_follower.core.errors import AdpError
from adp_path_follower.resources import PACKAGE

Work = TypeVar("Work")
_CONNECTING = 5.0  # [s] that a scheduler has to answer
_FIRST_WORKER = 30.0  # [s] that a scheduler has to find a worker
_WAITING_EACH = 2  # pieces of work for each worker: it never waits for the next
# Run by each worker: the whole terminal gets Ctrl-C, but only the command answers it.
_NO_INTERRUPT = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"
_LOOK = 0.2  # [s] between two looks for an interrupt
_RETRIES = 2  # of work that failed; a worker that dies is not counted


class Workers:
    """Workers elsewhere."""

    def __init__(self, client: Client, check_interrupts: Callable[[], None]) -> None:
        """Take a connected client, and what raises KeyboardInterrupt after Ctrl-C."""
        self._client, self._check_interrupts = client, check_interrupts

    @property
    def count(self) -> int:
        """Return how many pieces of work are done at once, now."""
        return max(1, sum(self._client.nthreads().values()))

    def begin(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the future of a piece of work; if its worker dies, another does it."""
        return self._client.submit(function, *arguments, pure=False, retries=_RETRIES)

    def result(self, future: Any) -> Any:
        """Wait for the result; AdpError if the work failed or the scheduler is gone."""
        self._check_interrupts()
        try:
            while not future.done():
                self._check_interrupts()
                with contextlib.suppress(TimeoutError):
                    future.result(_LOOK)
            return future.result()
        except KilledWorker as error:
            raise AdpError(
                f"a piece of the work ended {error.allowed_failures + 1} workers, one after the "
                "other: do they have enough memory?"
            ) from None
        except CancelledError:
            raise AdpError(
                "the scheduler is gone: what is done stays, and the same command goes on from it"
            ) from None
        except AdpError:
            raise
        except Exception as error:
            raise AdpError(f"a worker failed: {type(error).__name__}: {error}") from error

    def results(
        self, function: Callable[[Work], Any], work: Iterable[Work]
    ) -> Iterator[tuple[Work, Any]]:
        """Return work with its results, in order, a few pieces at a time; raises as `result`."""
        under_way: deque[tuple[Work, Any]] = deque()
        for piece in work:
            under_way.append((piece, self.begin(function, piece)))
            while len(under_way) >= _WAITING_EACH * self.count:  # workers come and go
                first, future = under_way.popleft()
                yield first, self.result(future)
        for first, future in under_way:
            yield first, self.result(future)


@contextlib.contextmanager
def workers(address: str | None, count: int | None = None) -> Iterator[Workers]:
    """Yield a scheduler's workers, as in "tcp://host:8786", or `count` processes (one a core) here.

    Raises AdpError if the scheduler does not answer, has no workers, or they lack this version.
    """
    for name in list(logging.root.manager.loggerDict):
        if name.partition(".")[0] == "distributed":  # tracebacks of lost connections, which are
            logging.getLogger(name).setLevel(logging.CRITICAL)  # raised here where they matter
    connected = _local(count) if address is None else _connected(address)
    with connected as client, noted_interrupts() as check_interrupts:
        yield Workers(client, check_interrupts)


@contextlib.contextmanager
def _local(count: int | None) -> Iterator[Client]:
    processes = count or len(os.sched_getaffinity(0))
    with (
        LocalCluster(
            n_workers=processes,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",  # any port: other commands may run beside
            silence_logs=logging.CRITICAL,
            preload=[_NO_INTERRUPT],
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Client]:
    try:
        _check_address(address)
        client = Client(address, timeout=_CONNECTING, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise AdpError(
            f"scheduler '{address}' cannot be reached ({reason}): start one with 'dask scheduler', "
            "and give the address that it prints, as in tcp://host:8786"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_FIRST_WORKER)
        except TimeoutError:
            raise AdpError(
                f"scheduler '{address}' has no workers: start some with 'dask worker {address} "
                "--nthreads 1'"
            ) from None
        _check_versions(client, address)
        yield client


def _check_address(address: str) -> None:
    """Raise ValueError for addresses that give a traceback or no answer in Dask's client."""
    scheme, place = parse_address(address)
    parse_host_port(place)
    secured = Security().get_connection_args("client").get("ssl_context") is not None
    known = ("tcp", "ws", "tls", "wss") if secured else ("tcp", "ws")
    if scheme not in known:
        raise ValueError(f"'{scheme}' is none of {', '.join(known)}")


def _check_versions(client: Client, address: str) -> None:
    """Reject workers without this version of the package."""
    versions_of: Any = client.get_versions(packages=[PACKAGE])
    for worker, versions in versions_of["workers"].items():
        version = versions["packages"].get(PACKAGE) or "none"
        if version != __version__:
            raise AdpError(
                f"worker {worker} of scheduler '{address}' has adp_path_follower {version}, but "
                f"this is {__version__}: install the same on all machines"
            )


@contextlib.contextmanager
def noted_interrupts() -> Iterator[Callable[[], None]]:
    """Note SIGINT, which raises nothing; yield what raises `KeyboardInterrupt` after one.

    Python ignores an exception in a destructor or a callback of the garbage collector, and Dask has
    both: an interrupt that raised at once would be lost there. Only the main thread receives it.
    """
    received: list[int] = []

    def check() -> None:
        if received:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield check
        return
    before = signal.signal(signal.SIGINT, lambda number, _: received.append(number))
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, before)
