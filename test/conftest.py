"""Fixtures and settings of all tests."""

from adp_path_follower.threads import use_one_blas_thread

use_one_blas_thread()  # as the executables do; before anything imports numpy

import gc
import os
from collections.abc import Callable, Iterator
from pathlib import Path as FilePath
from typing import Any

import hypothesis
import pytest

gc.disable()  # until all tests are imported: there is no garbage before
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
# Or a node is found by one that has started before it only after 1.4 s, in the median.
os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"] = str(
    FilePath(__file__).parents[1] / "bench" / "quick_discovery.xml"
)

# The same examples on every machine and in every run, however long they take there;
# HYPOTHESIS_PROFILE=search looks for others.
hypothesis.settings.register_profile("repeatable", derandomize=True, deadline=None)
hypothesis.settings.register_profile("search", derandomize=False, deadline=None)
hypothesis.settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "repeatable"))


def pytest_ignore_collect(collection_path: FilePath, config: pytest.Config) -> bool | None:
    """Import no file for its nodes, or its smoke tests, that has none: imports take seconds."""
    marker = config.getoption("markexpr")
    is_test = collection_path.name.startswith("test_") and collection_path.suffix == ".py"
    if marker in ("nodes", "smoke") and is_test:
        return f"mark.{marker}" not in collection_path.read_text(encoding="utf-8") or None
    return None


# The files that take longest, longest first: with the others at the end, workers end together.
_LONGEST = (
    *("study/optimum/test_optimum", "core/control/test_far_from_path", "study/test_paper"),
    "examples/test_examples",
    *("study/comparison/test_compare", "analysis/test_bag_page", "core/control/test_value_grid"),
    *("study/simulation/test_simulate", "study/sweeps/test_tuning", "cli/test_commands"),
    *("study/comparison/test_late_robot", "study/simulation/test_near_optimal"),
    *("study/comparison/test_peers", "bags/recovery/test_torn_bags", "core/robot/test_robot"),
    *("cli/test_sweep", "cli/test_analyze"),
    # The same for real nodes
    *("study/test_demo", "ros/controller/test_node", "ros/controller/test_far_values"),
    "cli/test_replay",
    *("ros/controller/test_begin_and_go_on", "ros/controller/test_safety"),
    *("ros/controller/test_weights", "ros/recorder/test_recorder"),
    *("ros/controller/test_left_alone", "ros/controller/test_follow_path"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run long files first; without `--no-loadscope-reorder` xdist has an order of its own."""
    here = FilePath(__file__).parent
    places = {here / f"{name}.py": place for place, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: places.get(item.path, len(places)))
    gc.freeze()  # modules and tests stay, and need not be looked through again and again
    gc.set_threshold(10_000, 20, 20)  # nor what one test needs
    gc.enable()


@pytest.fixture
def domain() -> Iterator[int]:
    """Yield the number of a DDS domain that nobody else uses."""
    from adp_path_follower.study.demo import own_domain

    with own_domain() as number:
        yield number


@pytest.fixture
def peer(domain: int) -> Iterator[Any]:
    """Yield a node in the test process, on the domain of the test."""
    from live_nodes import Peer

    found = Peer(domain)
    yield found
    found.close()


@pytest.fixture(scope="session")
def node_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Yield the process that nodes are forks of."""
    from forked_nodes import NodeServer
    from shared import made_once

    made_once("default_values", tmp_path_factory, _find_values)
    server = NodeServer()
    yield server
    server.close()


def _find_values(folder: FilePath) -> None:
    """Keep the default settings' values far from the path, or each node starts to find them."""
    from adp_path_follower.core.control.value_store import value_grid
    from adp_path_follower.core.settings.groups import Settings
    from adp_path_follower.core.settings.schema import build

    value_grid(build(Settings, {}))


@pytest.fixture
def start(domain: int, tmp_path: FilePath, node_server: Any) -> Iterator[Callable[..., Any]]:
    """Yield a function that starts nodes; they end with the test."""
    from forked_nodes import forked_node

    running: list[Any] = []

    def starter(executable: str, *arguments: str, **parameters: Any) -> Any:
        log = tmp_path / f"{executable}_{len(running)}.log"
        node = forked_node(node_server, executable, parameters, log, domain, arguments)
        running.append(node)
        return node

    yield starter
    for node in running:
        node.stop()
        print(f"{node.log}:\n{node.output()}")  # for whoever reads why a test failed
        assert "Traceback" not in node.output(), node.output()


@pytest.fixture(scope="session")
def recommended_run(tmp_path_factory: pytest.TempPathFactory) -> FilePath:
    """Return the bag of five seconds in lock-step with the recommended settings.

    Real nodes record it once for all workers; do not change it.
    """
    from shared import made_once

    return made_once("recommended_run", tmp_path_factory, _record) / "bag"


def _record(folder: FilePath) -> None:
    import numpy as np

    from adp_path_follower.core.path.library import lissajous
    from adp_path_follower.core.settings.groups import Settings
    from adp_path_follower.core.settings.parameter_file import load_settings
    from adp_path_follower.study.demo import run_closed_loop
    from adp_path_follower.study.simulation.simulate import PAPER_START

    settings = load_settings(Settings, "path_follower")
    start = np.array(PAPER_START)
    run_closed_loop(settings, lissajous(), "lissajous", start, 5.0, folder, lambda progress: None)


@pytest.fixture
def interfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let this process, and those that it starts, import nav2_msgs and tf2_msgs."""
    from interfaces import built_interfaces

    folder = str(built_interfaces())
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", folder, prepend=os.pathsep)


@pytest.fixture
def drive(peer: Any, start: Callable[..., Any]) -> Any:
    """Return a controller that follows a line."""
    from live_nodes import Drive

    return Drive(peer, start)


@pytest.fixture(scope="session")
def scheduler() -> Iterator[str]:
    """Yield the address of a Dask cluster whose only worker is a thread of the test process."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=":0"
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="session")
def paper() -> Any:
    """Return the paper's settings, all of them explicit and without limits of the command."""
    from printed import PAPER_SETTINGS

    return PAPER_SETTINGS


@pytest.fixture(scope="session")
def figure_eight() -> Any:
    """Return the product's figure eight."""
    from adp_path_follower.core.path.library import lissajous

    return lissajous()


@pytest.fixture(scope="session")
def printed() -> Any:
    """Return the paper's formulas, written from the paper and for one state at a time."""
    from printed import PrintedFormulas

    return PrintedFormulas()


@pytest.fixture(scope="session")
def explicit() -> Any:
    """Return the class of explicit polynomials of the error."""
    from printed import ExplicitPolynomial

    return ExplicitPolynomial
