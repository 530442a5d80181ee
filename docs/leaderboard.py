"""Write the leaderboard of docs/bench.md from results of the standard suite.

magtwin bench standard --runs 20 --out results
python docs/leaderboard.py results
"""

import re
import sys
from pathlib import Path

from magtwin.bench.leaderboard import Standing, standings
from magtwin.bench.results import read_results

PAGE = Path(__file__).with_name("bench.md")
BLOCK = re.compile(r"(<!-- leaderboard -->\n).*?(<!-- end -->)", re.DOTALL)


def cell(standing: Standing | None) -> str:
    """RMSE in cm, with the ratio to the bound and the ANEES; what went wrong in words."""
    if standing is None:
        return ""
    if standing.rmse_m is None:
        return "failed"
    text = f"{100 * standing.rmse_m.value:.1f}"
    if standing.diverged.value > 0.05:
        return f"{text}, diverges in {100 * standing.diverged.value:.0f} %"
    return f"{text} ({standing.ratio:.2f}, {standing.anees.value:.2f})"


def main() -> None:
    """Read the results and replace the block of the page."""
    made = read_results(*sys.argv[1:])
    every = standings(made.rows, made.times, made.compensated)
    by = {(s.localizer, s.scenario): s for s in every}
    scenarios = list(dict.fromkeys(s.scenario for s in every))
    lines = [f"| | {' | '.join(scenarios)} | us a step |", "|---" * (len(scenarios) + 2) + "|"]
    for name in dict.fromkeys(s.localizer for s in every):
        cells = [cell(by.get((name, scenario))) for scenario in scenarios]
        cost = by[name, scenarios[0]].step_us
        lines.append(f"| `{name}` | {' | '.join(cells)} | {cost:,.0f} |")
    runs = {s.runs for s in every}
    count = f"{min(runs)}" if len(runs) == 1 else f"{min(runs)} to {max(runs)}"
    about = made.about
    lead = (
        f"{count} runs of each scenario, {about['seeds']} seeds, each in another session; magtwin "
        f"{about['magtwin']}, suite {about['name']} version {about['version']}. RMSE of the position [cm]; "
        "in brackets divided by the bound, and the median ANEES per state. The time of a step is that of the "
        "first scenario."
    )
    block = "\n".join(["## Leaderboard", "", lead, "", *lines, ""])
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(BLOCK.sub(lambda match: match[1] + block + match[2], text), encoding="utf-8")


if __name__ == "__main__":
    main()
