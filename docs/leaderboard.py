"""Write the leaderboard of docs/bench.md from results of the standard suite.

magtwin bench standard --runs 12 --out results
python docs/leaderboard.py results
"""

import math
import re
import sys
from pathlib import Path

from magtwin.bench.leaderboard import Standing, letters, standings
from magtwin.bench.results import read_results
from magtwin.bench.statistics import Interval

PAGE = Path(__file__).with_name("bench.md")
BLOCK = re.compile(r"(<!-- leaderboard -->\n).*?(<!-- end -->)", re.DOTALL)


def cell(standing: Standing | None, same: str) -> str:
    """Median RMSE in cm with its interval and letter; rates and what went wrong in words."""
    if standing is None:
        return ""
    if standing.median is None:
        return "failed"
    low, high = (f"{100 * value:.1f}" for value in standing.median[1:])
    text = f"{100 * standing.median_m:.1f} {same} ({low} to {high})"
    if standing.bound_m > 0:
        text += f", {standing.median_m / standing.median_bound_m:.2f}"
    for rate, words in ((standing.converged, "found"), (standing.recovered, "recovered")):
        text += "" if rate is None else f", {words} {percent(rate)}"
    if standing.diverged.value > 0:
        text += f", diverged {percent(standing.diverged)}"
    outside = 1 - standing.anees_inside
    return text + ("" if math.isnan(outside) else f", {100 * outside:.0f} % outside")


def percent(rate: Interval) -> str:
    """A rate with its interval."""
    return f"{100 * rate.value:.0f} % ({100 * rate.low:.0f} to {100 * rate.high:.0f})"


def main() -> None:
    """Read the results and replace the block of the page."""
    made = read_results(*sys.argv[1:])
    every = standings(made.rows, made.times, made.compensated)
    by = {(s.localizer, s.scenario): s for s in every}
    scenarios = list(dict.fromkeys(s.scenario for s in every))
    same = {each: letters(made.rows, [s for s in every if s.scenario == each]) for each in scenarios}
    lines = [f"| | {' | '.join(scenarios)} | us a step |", "|---" * (len(scenarios) + 2) + "|"]
    for name in dict.fromkeys(s.localizer for s in every):
        cells = [cell(by.get((name, each)), same[each].get(name, "")) for each in scenarios]
        costs = [s.step_us for s in every if s.localizer == name]
        lines.append(f"| `{name}` | {' | '.join(cells)} | {costs[0]:,.0f} |")
    runs = {s.runs for s in every}
    count = f"{min(runs)}" if len(runs) == 1 else f"{min(runs)} to {max(runs)}"
    about = made.about
    lead = (
        f"{count} runs of each scenario, {about['seeds']} seeds; magtwin {about['magtwin']}, suite "
        f"{about['name']} version {about['version']}. Median over runs of the RMSE of the position [cm], "
        "with its 95 % interval over places, and divided by the median bound. Methods of a column with a "
        "letter in common could not be told apart (paired runs, p 0.05). Rates have their 95 % interval. "
        "outside: runs whose ANEES is not in its 95 % chi-square interval. The time of a step is that of the "
        "first scenario."
    )
    block = "\n".join(["## Leaderboard", "", lead, "", *lines, ""])
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(BLOCK.sub(lambda match: match[1] + block + match[2], text), encoding="utf-8")


if __name__ == "__main__":
    main()
