"""Clock: the time and the timers of a node, by wall time or by /clock."""

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


class Clock:
    """Wall time, or simulated time.

    A timer keeps its phase: after missed steps it is called once, then at its next regular step. If time
    jumps back, as when a simulation restarts, steps count from there.
    """

    def __init__(self, *, sim_time: bool = False) -> None:
        """Start; simulated time is 0 until it is set."""
        self.sim_time = sim_time
        self._now_ns = 0
        self._alarms: list[Alarm] = []
        self.due_wall_ns = 0
        """Wall time at which the current timer was due; in simulated time, when that time was sent [ns]."""

    def now_ns(self) -> int:
        """Time [ns]."""
        return self._now_ns if self.sim_time else time.time_ns()

    def tell(self, now_ns: int, sent_ns: int = 0) -> None:
        """Set simulated time [ns], which was sent at a wall time [ns]."""
        self.due_wall_ns = sent_ns
        back = now_ns < self._now_ns
        self._now_ns = now_ns
        for alarm in self._alarms:
            if not alarm.wall and (back or not alarm.next_ns):
                alarm.next_ns = now_ns + alarm.period_ns

    def timer(self, period_s: float, due: Callable[[], None], *, wall: bool = False) -> Alarm:
        """Call `due` every `period_s` [s], of this clock or of wall time."""
        period_ns = max(int(period_s * NS), 1)  # rounding up would miss steps of a /clock of the same period
        wall = wall or not self.sim_time
        now = self._time_ns(wall)
        alarm = Alarm(period_ns, due, now + period_ns if now else 0, wall)
        self._alarms.append(alarm)
        return alarm

    def left_s(self, most_s: float) -> float:
        """Wall time until the next timer, at most `most_s` [s]; unknown in simulated time."""
        live = [alarm.next_ns for alarm in self._alarms if alarm.wall]
        if not live:
            return most_s
        return min(max((min(live) - time.monotonic_ns()) / NS, 0.0), most_s)

    def run_due(self) -> None:
        """Call the timers that are due."""
        for alarm in list(self._alarms):
            now = self._time_ns(alarm.wall)
            if alarm.next_ns and alarm.next_ns <= now:
                if not self.sim_time:
                    self.due_wall_ns = time.time_ns() - (now - alarm.next_ns)
                alarm.next_ns += alarm.period_ns * ((now - alarm.next_ns) // alarm.period_ns + 1)
                alarm.due()

    def _time_ns(self, wall: bool) -> int:
        # The monotonic clock, which is never set.
        return time.monotonic_ns() if wall else self._now_ns
