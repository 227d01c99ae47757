"""The robot's service that says which of its own controllers moves it: the SDK's bytes, and a release.

Golden bytes: unitree_sdk2_python at 37116c5 on cyclonedds 11.0.1, `serialize()` of its Request_ and Response_.
"""

import threading
import time

import pytest
from lockstep import Memory

from omnirobot.runtime import DeployError
from omnirobot.wire.switcher import (
    CHECK,
    RELEASE,
    Answered,
    Asked,
    Switcher,
    SwitcherService,
    ensure_released,
)

REQUEST_BYTES = "00010000141a99be1c000000eb0300000000000000000000000000000000000000000000030000007b7d000000000000"
RESPONSE_BYTES = (
    "00010000141a99be1c000000e903000000000000000000001a0000007b22666f726d223a2230222c226e616d65223a226d6366227d00"
    "000000000000"
)


def test_bytes_are_the_sdks():
    asked = Asked(123456789012, RELEASE)
    answered = Answered(123456789012, CHECK, 0, '{"form":"0","name":"mcf"}')
    assert asked.to_cdr().hex() == REQUEST_BYTES and Asked.from_cdr(asked.to_cdr()) == asked
    assert answered.to_cdr().hex() == RESPONSE_BYTES and Answered.from_cdr(answered.to_cdr()) == answered
    for cut in (10, 40):
        with pytest.raises(DeployError, match="motion_switcher"):
            Answered.from_cdr(answered.to_cdr()[:cut])


class Stubborn(SwitcherService):
    """Answers, and goes on."""

    controller = property(lambda self: "mcf", lambda self, name: None)


@pytest.fixture
def robot():
    """Makes a service that answers by itself."""
    ended, threads = threading.Event(), []

    def make(controller, network=None):
        network = network or Memory()
        service = SwitcherService(network, controller)

        def serve():
            while not ended.is_set():
                service.answer()
                time.sleep(0.002)

        threads.append(threading.Thread(target=serve))
        threads[-1].start()
        return network, service

    yield make
    ended.set()
    for thread in threads:
        thread.join()


def test_a_controller_that_runs_is_refused_or_released(robot):
    network, service = robot("mcf")
    with pytest.raises(DeployError, match="the on-board controller 'mcf' moves the robot: lay it down"):
        ensure_released(network, "check")
    assert service.controller == "mcf"
    ensure_released(network, "release")
    assert service.controller == "" and Switcher(network).controller() == ""
    ensure_released(network, "check")


def test_a_controller_that_does_not_end_is_an_error(robot):
    network, service = robot("mcf")
    service.__class__ = Stubborn
    with pytest.raises(DeployError, match="'mcf' still runs 0.2 s after its release"):
        Switcher(network).release(timeout_s=0.2)


def test_silence_is_no_release():
    assert Switcher(Memory()).controller(timeout_s=0.05) is None
    ensure_released(Memory(), "ignore")


def test_over_dds(robot):
    pytest.importorskip("cyclonedds", reason="extra robot")
    from omnirobot.wire.dds import Network

    network, service = robot("mcf", Network(domain=75))
    asking = Switcher(network)
    assert asking.controller(timeout_s=60.0) == "mcf"
    asking.release(timeout_s=60.0)
    assert service.controller == ""
