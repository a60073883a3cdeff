"""Learned weights from the run before, and for the next one."""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import LifecycleNode
from rclpy.task import Future
from std_msgs.msg import UInt8MultiArray
from std_srvs.srv import Trigger

from adp_path_follower.core.driving.driver import Driver
from adp_path_follower.core.errors import AdpError
from adp_path_follower.core.files import expanded
from adp_path_follower.core.learning.weights_file import (
    SavedWeights,
    encode,
    read_weights,
    write_weights,
)
from adp_path_follower.core.settings.groups import Settings
from adp_path_follower.ros.runtime.qos import LATCHED


class WeightsFiles:
    """Reads `weights_file` at the start, and writes `save_weights_to` when it is asked to."""

    def __init__(self, node: LifecycleNode, settings: Settings, driver: Callable[[], Driver]):
        """Read the weights (FileError if they do not fit), and offer to save those of `driver`."""
        self._node, self._driver = node, driver
        self._is_writing = False
        self.saved: SavedWeights | None = None
        self._content = b""
        name = settings.controller.weights_file
        if name:
            file = expanded(name).absolute()
            self.saved, self._content = read_weights(file, settings)
            node.get_logger().info(f"weights to start from: {file}")
        # A group of its own: whatever is in the node's is not called while this one waits. It goes
        # with the node, not with the others, as there may be an answer on its way.
        node.create_service(
            Trigger, "~/save_weights", self._save, callback_group=ReentrantCallbackGroup()
        )

    @property
    def digest(self) -> str:
        """Return the hash of the weights to start from, empty without."""
        return "" if self.saved is None else self.saved.digest

    def entities(self) -> list[tuple[Any, Any]]:
        """Create the topic that makes a recording complete; return it with its destructor."""
        if not self._content:
            return []
        publisher = self._node.create_publisher(UInt8MultiArray, "~/initial_weights", LATCHED)
        publisher.publish(UInt8MultiArray(data=self._content))
        return [(self._node.destroy_publisher, publisher)]

    async def _save(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Save what was learned until now, or answer why not: an exception would end the node."""
        try:
            response.message = await self._saved()
            response.success = True
        except AdpError as error:
            response.message = str(error)
        except Exception as error:
            response.message = f"weights cannot be saved: {type(error).__name__}: {error}"
        return response

    async def _saved(self) -> str:
        """Return a report of saving in a thread, so that no command waits; AdpError if it fails."""
        if self._is_writing:
            raise AdpError("weights are still being written: ask again when that is done")
        driver = self._driver()
        if driver.follower is None:
            raise AdpError("nothing was learned yet: save the weights after some driving")
        saved = replace(driver.follower.saved_weights(), robot=driver.robot.learned)
        name = driver.settings.controller.save_weights_to
        if not name:
            raise AdpError("'save_weights_to' is empty: set it to the file to write")
        file = expanded(name).absolute()
        written: Future = Future(executor=self._node.executor)
        self._is_writing = True
        try:
            threading.Thread(target=_write, args=(file, saved, written), daemon=True).start()
            await written
        finally:
            self._is_writing = False
        count = len(saved.learned.knots)
        places = "" if count == 1 else f" at {count} places of the path"
        return f"weights{places} are in {file}"


def _write(file: FilePath, saved: SavedWeights, written: Future) -> None:
    """Write the file; everything that goes wrong is the future's exception."""
    try:
        write_weights(file, encode(saved))
    except Exception as error:  # the thread has nobody else to tell
        written.set_exception(error)
    else:
        written.set_result(None)
