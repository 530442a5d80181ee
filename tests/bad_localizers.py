"""Localizers that fail, each in another way, for tests of the testbed."""

import ctypes
import signal
import sys
import time

from magtwin.localization.odometry import Odometry
from magtwin.localization.problem import Estimate


class _Bad(Odometry):
    """Odometry that fails from a time on."""

    after_s = 2.0

    def step(self, reading):
        estimate = super().step(reading)
        return self.fail(estimate) if reading.t > self.after_s else estimate


class Raises(_Bad):
    def fail(self, estimate):
        raise ZeroDivisionError("no particles left")


class Sleeps(_Bad):
    def fail(self, estimate):
        try:
            time.sleep(60)
        except Exception:
            time.sleep(60)


class Hangs(_Bad):
    def fail(self, estimate):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})  # as compiled code does not notice it
        time.sleep(60)


class Crashes(_Bad):
    def fail(self, estimate):
        ctypes.memset(0, 0, 1)


class Exits(_Bad):
    def fail(self, estimate):
        sys.exit(3)


class Nan(_Bad):
    def fail(self, estimate):
        return Estimate(estimate.t, float("nan"), estimate.y, estimate.yaw)


class Future(_Bad):
    def fail(self, estimate):
        return Estimate(estimate.t + 0.1, estimate.x, estimate.y, estimate.yaw)


class Shape(_Bad):
    def fail(self, estimate):
        return Estimate(estimate.t, estimate.x, estimate.y, estimate.yaw, covariance=[[1.0, 0.0], [0.0, 1.0]])
