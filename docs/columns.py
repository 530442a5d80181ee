"""Write columns.md from `magtwin.COLUMNS`: `python docs/columns.py`."""

from pathlib import Path

from magtwin.run.run import COLUMNS

HERE = Path(__file__).resolve().parent

INTRODUCTION = """\
# Columns of a Run

A Run is a table with one row per magnetometer reading. This page lists the columns that magtwin writes.

- Names, units and frames are stable. New columns may be added, but none changes its meaning. A localizer
  adds `est_*`, and you can add your own.
- Slower signals are held: a row has the latest value known at its time.
- Fields are in nT (the Earth's is about 50,000), angles in rad. nan means unknown.
- In Python a vector is one array: `run["odom_p"]` has shape (N, 3). In tables (Parquet, CSV, pandas, ...)
  it has one column per part: `odom_p_x`, `odom_p_y`, `odom_p_z`. The parts of a quaternion are x, y, z, w.
- `bool` columns are flags; all others are float64.

The last column of the table is the rule by which `Run.resample` finds values between two rows: **linear**;
**angle**, linear along the shorter arc; **quaternion**, at constant rate (slerp); **hold**, the value of
the row before, so that no future value is used.
"""


def page() -> str:
    """The page, from `COLUMNS`."""
    lines = [
        INTRODUCTION,
        "| column | parts | unit | frame | meaning | between rows |",
        "|---|---|---|---|---|---|",
    ]
    for name, spec in COLUMNS.items():
        cells = [f"`{name}`", ", ".join(spec.parts), spec.unit, spec.frame, spec.doc, spec.interpolation]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join([*lines, "", ERRORS])


ERRORS = """Each error has its own column. Where all are known:

    b_total_nt = b_map_nt + b_disturbance_nt
    b_measured_nt = b_total_nt + b_model_error_nt + b_noise_nt
    b_truth_nt = |b_vector_nt|, and = b_total_nt of a physical magnetometer

A neural run with fields that its network does not know (a plant, the iron of other robots, custom
interference) also has `b_unmodelled_nt`, their part of b_disturbance_nt. The error of the prediction is
b_total_nt - b_unmodelled_nt - b_truth_nt.
"""


if __name__ == "__main__":
    (HERE / "columns.md").write_text(page(), encoding="utf-8")
