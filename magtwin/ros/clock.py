"""Clock: a node's time and its timers, by the wall or by /clock."""

import time
from collections.abc import Callable
from dataclasses import dataclass

NS = 10**9


@dataclass(eq=False)
class Alarm:
    """A timer."""

    period_ns: int
    due: Callable[[], None]
    next_ns: int
    wall: bool = False
    live: bool = True

    def cancel(self) -> None:
        """Call it no more."""
        self.live = False


class Clock:
    """Time that goes on with the wall's, or as it is told.

    A timer keeps its step: one that could not be called in time is called once, and its next time is the
    next of its even steps. Where time jumps back, as when a simulation begins anew, steps count from there.
    """

    def __init__(self, *, sim_time: bool = False) -> None:
        """Begin; a clock of sim time stands at 0 until it is told."""
        self.sim_time = sim_time
        self._now_ns = 0
        self._alarms: list[Alarm] = []
        self.due_wall_ns = 0
        """When the timer that is being called was due, by the wall: in sim time, when that was told [ns]."""

    def now_ns(self) -> int:
        """Time [ns]."""
        return self._now_ns if self.sim_time else time.time_ns()

    def tell(self, now_ns: int, sent_ns: int = 0) -> None:
        """Set sim time [ns], which was sent at a wall time [ns]."""
        self.due_wall_ns = sent_ns
        back = now_ns < self._now_ns
        self._now_ns = now_ns
        for alarm in self._alarms:
            if not alarm.wall and (back or not alarm.next_ns):
                alarm.next_ns = now_ns + alarm.period_ns

    def timer(self, period_s: float, due: Callable[[], None], *, wall: bool = False) -> Alarm:
        """Call `due` in steps of `period_s` [s] from now on, of this clock or of the wall's."""
        period_ns = max(int(period_s * NS), 1)  # rounded up it would miss steps of a /clock as fine
        wall = wall or not self.sim_time
        now = self._time_ns(wall)
        alarm = Alarm(period_ns, due, now + period_ns if now else 0, wall)
        self._alarms.append(alarm)
        return alarm

    def left_s(self, most_s: float) -> float:
        """Wall time until the next timer, at most `most_s` [s]; sim time cannot be foreseen."""
        live = [alarm.next_ns for alarm in self._alarms if alarm.live and alarm.wall]
        if not live:
            return most_s
        return min(max((min(live) - time.monotonic_ns()) / NS, 0.0), most_s)

    def run_due(self) -> None:
        """Call the timers whose time has come."""
        self._alarms = [alarm for alarm in self._alarms if alarm.live]
        for alarm in list(self._alarms):
            now = self._time_ns(alarm.wall)
            if alarm.live and alarm.next_ns and alarm.next_ns <= now:
                if not self.sim_time:
                    self.due_wall_ns = time.time_ns() - (now - alarm.next_ns)
                alarm.next_ns += alarm.period_ns * ((now - alarm.next_ns) // alarm.period_ns + 1)
                alarm.due()

    def _time_ns(self, wall: bool) -> int:
        # Steps of wall time are the monotonic clock's, which nobody sets.
        return time.monotonic_ns() if wall else self._now_ns
