"""The nodes' executor: it does what rclpy's does, over real DDS."""

from __future__ import annotations

import signal
import threading

import pytest
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from adp_path_follower.ros.runtime.executor import DirectExecutor
from live_nodes import TIMEOUT, is_zero, running_script

pytestmark = pytest.mark.nodes


class Spun:
    """A node in a context of its own, spun beside a peer."""

    def __init__(self, domain, peer):
        self.context = rclpy.Context()
        self.context.init(domain_id=domain)
        self.node = rclpy.create_node("spun", context=self.context)
        self.executor = DirectExecutor(self.node)
        self.peer = peer
        self.numbers = peer.node.create_publisher(Float64, "numbers", 100)
        self.received = []

    def until(self, condition, what):
        """Spin both nodes until a condition holds."""

        def done():
            self.executor.spin_once(0.005)
            return condition()

        self.peer.until(done, what)

    def subscribe(self, callback, **options):
        """Return a subscription to the peer's numbers that is known to it."""
        subscription = self.node.create_subscription(Float64, "numbers", callback, 100, **options)
        self.until(self.numbers.get_subscription_count, "the subscription")
        return subscription

    def close(self):
        """Leave the domain."""
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def spun(domain, peer):
    found = Spun(domain, peer)
    yield found
    found.close()


def test_messages_come_in_order_and_to_subscriptions_made_while_it_spins(spun):
    received = []
    first = spun.subscribe(lambda message: received.append(message.data))
    for number in range(50):
        spun.numbers.publish(Float64(data=float(number)))
    spun.until(lambda: len(received) == 50, "all messages")
    assert received == [float(number) for number in range(50)]
    spun.node.destroy_subscription(first)
    raw, informed = [], []
    spun.subscribe(raw.append, raw=True)
    spun.subscribe(lambda message, info: informed.append((message.data, info)))
    spun.until(lambda: spun.numbers.get_subscription_count() == 2, "both subscriptions")
    spun.numbers.publish(Float64(data=7.0))
    spun.until(lambda: raw and informed, "a message for both")
    assert len(received) == 50
    assert isinstance(raw[0], bytes)
    assert informed[0][0] == 7.0
    assert informed[0][1]["source_timestamp"] > 0


def test_a_callback_may_destroy_what_is_ready_beside_it(spun):
    received = []

    def take(message):
        received.append(message.data)
        for subscription in subscriptions:
            spun.node.destroy_subscription(subscription)
        subscriptions.clear()

    subscriptions = [spun.subscribe(take), spun.subscribe(take)]
    spun.until(lambda: spun.numbers.get_subscription_count() == 2, "both subscriptions")
    spun.numbers.publish(Float64(data=1.0))
    assert spun.numbers.wait_for_all_acked(rclpy.duration.Duration(seconds=5.0))
    spun.until(lambda: received, "the message")
    for _ in range(20):
        spun.executor.spin_once(0.005)
    assert received == [1.0]


def test_timers_fire_at_their_rate_until_they_are_cancelled(spun):
    steady, times = Clock(clock_type=ClockType.STEADY_TIME), []
    timer = spun.node.create_timer(
        0.02, lambda: times.append(steady.now().nanoseconds), clock=steady
    )
    spun.until(lambda: len(times) >= 20, "twenty calls")
    # A late call is made up for, so that on the whole it is never too often.
    assert times[-1] - times[0] > 0.8 * (len(times) - 1) * 20_000_000
    timer.cancel()
    count = len(times)
    for _ in range(20):
        spun.executor.spin_once(0.005)
    assert len(times) == count


def test_services_answer_while_messages_keep_coming(spun):
    received = []
    spun.subscribe(received.append)

    def answer(request, response):
        response.success, response.message = True, str(len(received))
        return response

    spun.node.create_service(Trigger, "count", answer)
    spun.peer.node.create_timer(0.001, lambda: spun.numbers.publish(Float64()))
    client = spun.peer.node.create_client(Trigger, "count")
    spun.until(client.service_is_ready, "the service")
    futures = [client.call_async(Trigger.Request()) for _ in range(3)]
    spun.until(lambda: all(future.done() for future in futures), "three answers")
    assert all(future.result().success for future in futures)
    assert received


def test_a_service_may_wait_for_another_thread(spun):
    waited_for = []

    async def answer(request, response):
        future = Future(executor=spun.executor)
        waited_for.append(future)
        response.success = await future
        return response

    spun.node.create_service(Trigger, "wait", answer, callback_group=ReentrantCallbackGroup())
    client = spun.peer.node.create_client(Trigger, "wait")
    spun.until(client.service_is_ready, "the service")
    future = client.call_async(Trigger.Request())
    spun.until(lambda: waited_for, "the request")
    received = []
    spun.subscribe(received.append)
    spun.numbers.publish(Float64())
    spun.until(lambda: received, "a message while it waits")
    assert not future.done()
    threading.Thread(target=waited_for[0].set_result, args=(True,)).start()
    spun.until(future.done, "the answer")
    assert future.result().success


def test_a_guard_condition_of_another_thread_wakes_it(spun):
    calls = []
    guard = spun.node.create_guard_condition(lambda: calls.append(None))
    threading.Timer(0.1, guard.trigger).start()
    spun.until(lambda: calls, "the call")
    for _ in range(10):
        spun.executor.spin_once(0.005)
    assert len(calls) == 1


def test_events_of_the_middleware_arrive(spun):
    from rclpy.event_handler import SubscriptionEventCallbacks

    told = []
    spun.node.create_subscription(
        Float64,
        "numbers",
        spun.received.append,
        QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL),
        event_callbacks=SubscriptionEventCallbacks(incompatible_qos=told.append),
    )
    spun.until(lambda: told, "word of the publisher that keeps nothing")


def test_an_error_in_a_callback_ends_the_spin(spun):
    def fail(message):
        raise ValueError("a callback failed")

    spun.subscribe(fail)
    spun.numbers.publish(Float64())
    with pytest.raises(ValueError, match="a callback failed"):
        spun.until(lambda: False, "the error")
    spun.context.try_shutdown()
    with pytest.raises(ExternalShutdownException):
        spun.executor.spin_once(0.01)


OTHER_INTERNALS = """
import importlib.util, pathlib, re, sys, types

# A fork has imported what must be imported again.
for known in [*sys.modules]:
    if known.startswith(("rclpy", "adp_path_follower.ros", "sim_unicycle")):
        del sys.modules[known]
spec = importlib.util.find_spec("rclpy.executors")
source = pathlib.Path(spec.origin).read_text()
renamed, count = re.subn(r"\\bself\\.{name}\\b", "self._renamed", source)
assert count > 1
module = importlib.util.module_from_spec(spec)
sys.modules["rclpy.executors"] = module
exec(compile(renamed, spec.origin, "exec"), module.__dict__)

from adp_path_follower.ros.runtime.entry import controller

sys.argv = ["controller"]
controller()
"""


@pytest.mark.parametrize("name", ["_guard", "_tasks"])
def test_with_other_internals_of_rclpy_the_node_drives_by_the_executor_of_rclpy(
    domain, node_server, peer, tmp_path, name
):
    commands = peer.listen(TwistStamped, "cmd_vel")
    log = tmp_path / "log"
    with running_script(
        node_server, OTHER_INTERNALS.replace("{name}", name), domain, log
    ) as process:
        peer.until_matched(peer.odometry, peer.path)
        peer.node.create_timer(0.02, lambda: peer.send_odometry((0.0, 0.1, 0.0)))
        peer.send_path()
        peer.until(
            lambda: len(commands) >= 50 and not any(map(is_zero, commands[-10:])),
            "commands to move",
        )
        assert peer.call(Trigger, "path_follower/stop").success
        peer.until(lambda: is_zero(commands[-1]), "zero velocity")
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT) == 0
    lines = [line for line in log.read_text().splitlines() if "rclpy's own executor" in line]
    assert len(lines) == 1
    assert lines[0].endswith(f"has no attribute '{name}'")
