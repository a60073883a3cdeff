"""Learned weights from the run before, and for the next one."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.lifecycle import LifecycleNode
from rclpy.task import Future
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import Trigger

from adp_path_follower.core.driver import Driver
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.settings import Settings
from adp_path_follower.core.weights_file import (
    SavedWeights,
    encode,
    read_weights,
    write_weights,
)
from adp_path_follower.nodes.delivery import LATCHED


class WeightsFiles:
    """Reads `weights_file` at the start, and writes `save_weights_to` when it is asked to.

    Attributes:
        saved: The weights to start from, None without.

    """

    def __init__(self, node: LifecycleNode, settings: Settings, driver: Callable[[], Driver]):
        """Read the weights.

        Args:
            node: The controller.
            settings: Its settings.
            driver: Returns what learns.

        Raises:
            FileError: The file is none that these settings can start from.

        """
        self._node, self._driver = node, driver
        self.saved: SavedWeights | None = None
        self._content = b""
        name = settings.controller.weights_file
        if name:
            file = Path(name).expanduser().absolute()
            self.saved, self._content = read_weights(file, settings)
            node.get_logger().info(f"weights to start from: {file}")

    @property
    def digest(self) -> str:
        """Return the hash of the weights to start from, empty without."""
        return "" if self.saved is None else self.saved.digest

    def entities(self) -> list[tuple[Any, Any]]:
        """Create the service, and the topic that makes a recording complete.

        Returns:
            Pairs of what destroys an entity, and the entity.

        """
        node = self._node
        service = node.create_service(Trigger, "~/save_weights", self._save)
        made: list[tuple[Any, Any]] = [(node.destroy_service, service)]
        if self._content:
            publisher = node.create_publisher(UInt8MultiArray, "~/initial_weights", LATCHED)
            publisher.publish(UInt8MultiArray(data=self._content))
            made.append((node.destroy_publisher, publisher))
        return made

    async def _save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Save what was learned until now; a thread writes, so that no disk delays a command."""
        driver = self._driver()
        try:
            if driver.follower is None:
                raise AdpError("nothing was learned yet: save the weights after some driving")
            saved = driver.follower.saved_weights()
            name = driver.settings.controller.save_weights_to
            if not name:
                raise AdpError("'save_weights_to' is empty: set it to the file to write")
            file = Path(name).expanduser().absolute()
            written: Future = Future(executor=self._node.executor)
            threading.Thread(target=_write, args=(file, saved, written), daemon=True).start()
            await written
        except AdpError as error:
            response.success, response.message = False, str(error)
        else:
            count = len(saved.learned.knots)
            places = "" if count == 1 else f" at {count} places of the path"
            response.success, response.message = True, f"weights{places} are in {file}"
        return response


def _write(file: Path, saved: SavedWeights, written: Future) -> None:
    """Write the file; everything that goes wrong is the future's exception."""
    try:
        write_weights(file, encode(saved))
    except Exception as error:  # the thread has nobody else to tell
        written.set_exception(error)
    else:
        written.set_result(None)
