# SPDX-License-Identifier: Apache-2.0
"""Defines what is done to driver and controller at the moment of a lie.

Each function takes a `LyingDriver` and returns what to do: pairs of a time from that moment [s] and a call.
"""

import numpy as np

from flexarm_control.loop.samples import ArmSample
from flexarm_dynamics.arm.strain_map import gauge_rows

from ..loop import scenario as scenarios

#: Spoofed torque as a fraction of the limit [-], and its duration [s].
SPOOFED, SPOOFED_FOR = -1.0, 0.02
#: A limit is set to this fraction of the value that it watches [-].
BELOW = 0.9


def credulous_gate(driver):
    """A message that is sent again renews the time of its torque."""
    return [(0.0, lambda: setattr(driver.gate, "renews", True))]


def refuse(driver):
    """The drives do not take the torque any more."""
    return [(0.0, lambda: setattr(driver, "refuses", True))]


def refuse_a_second(driver):
    """The drives do not take the torque for a second."""
    return [*refuse(driver), (1.0, lambda: setattr(driver, "refuses", False))]


def spoof(driver):
    """Another sender sends torques under the controller's name for a while."""
    torque = SPOOFED * driver.loop.model.arm.torque_limits
    return [
        (0.0, lambda: setattr(driver, "spoofed", torque)),
        (SPOOFED_FOR, lambda: setattr(driver, "spoofed", None)),
    ]


def fail(driver):
    """A fault. It is the scale for every lie that ends in a fault: then the safe action alone stops the arm."""
    return [(0.0, lambda: driver.loop.controller.fail("attack: a fault of its own"))]


def recover_moving(driver):
    """A fault, and `~/recover` while the arm still moves."""
    controller = driver.loop.controller
    return [
        (0.0, lambda: controller.fail("attack: a fault of its own")),
        (0.02, controller.recover),
    ]


def restart_soon(driver):
    """The controller is killed; the new one answers after 20 ms, while the old one's torque still acts."""
    return _restart(driver, 0.02)


def restart_later(driver):
    """The controller is killed; the new one answers after 200 ms, while the safe action acts."""
    return _restart(driver, 0.2)


def _restart(driver, after):
    fresh = scenarios.loop_of(driver.scenario).controller

    def kill():
        driver.answers = False

    def start():
        driver.loop.controller, driver.answers = fresh, True
        driver.controller_id += 1
        fresh.controller_id = driver.controller_id

    return [(0.0, kill), (after, start)]


def restart_observer(driver):
    """The observer is killed and started again at once."""
    fresh = scenarios.loop_of(driver.scenario).observer
    return [(0.0, lambda: setattr(driver.loop, "observer", fresh))]


def stop(driver):
    """`~/stop`."""
    return [(0.0, lambda: driver.loop.controller.brake("~/stop was called"))]


def limit_tracking(driver):
    """The limit of the tracking error is below the present error."""
    return _limit(
        driver, "tracking_error_limit", lambda: np.abs(driver.loop.controller.position_error).max()
    )


def limit_strain(driver):
    """The limit of the strain is below the present strain."""
    model = driver.loop.model
    rows = gauge_rows(model, model.arm.gauges)
    return _limit(
        driver, "strain_limit", lambda: np.abs(rows @ driver.loop.estimated.amplitude).max()
    )


def limit_deflection(driver):
    """The limit of the largest modal amplitude is below the present one."""

    def largest():
        amplitude = np.abs(driver.loop.estimated.amplitude)
        return np.where(amplitude == amplitude.max(), amplitude, 0.0)

    return _limit(driver, "deflection_limit", largest)


def _limit(driver, name, present):
    """Set a limit that has just been exceeded; when the stop has begun, the old limit is restored."""
    controller = driver.loop.controller
    old = dict(controller.supervisor.settings)

    def lower():
        value = BELOW * present()
        value = value.tolist() if isinstance(value, np.ndarray) else float(value)
        controller.configure(old | {name: value})

    return [(0.0, lower), (2.0 * driver.period, lambda: controller.configure(old))]


def asked_to_stop(driver):
    """The observer requests once that the arm is brought to rest."""

    def ask():
        driver.trust, driver.reason = ArmSample.STOP, "attack: the device asks for a stop"

    def trust_again():
        driver.trust, driver.reason = ArmSample.TRUSTED, ""

    return [(0.0, ask), (driver.period, trust_again)]
