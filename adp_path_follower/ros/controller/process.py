"""The controller as a process: first the one that prepares paths beside it, then the node."""

from adp_path_follower.ros.controller.path_process import FittingProcess


def main() -> int:
    """Run the node; return its exit code."""
    with FittingProcess() as fitting:
        # Only now: the imports of the two processes take half a second, and go on side by side.
        from adp_path_follower.ros.controller.node import NODE_NAME, PathFollowerNode
        from adp_path_follower.ros.runtime.run import run_node

        return run_node(NODE_NAME, lambda: PathFollowerNode(fitting.route))
