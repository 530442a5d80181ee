"""Write columns.md from `magtwin.COLUMNS`: `python docs/columns.py`."""

from pathlib import Path

from magtwin.run.run import COLUMNS

HERE = Path(__file__).resolve().parent

INTRODUCTION = """\
# Columns of a Run

One row a magnetometer reading. Signals that are slower are held: a row has the latest that was known by then.
These names, units and frames are stable: a column may be added, none changes what it means. A localizer adds
`est_*`, and a user what they like.

In Python a vector is one array, `run["odom_p"]` of shape (N, 3). In tables (Parquet, CSV, pandas, ...)
it is one column a part, `odom_p_x`, `odom_p_y`, `odom_p_z`; parts of a quaternion are x, y, z, w. `bool`
columns are flags, all others float64. Fields are in nT (the Earth's is about 50,000), angles in rad; nan
stands where nothing is known.

Between two rows `Run.resample` reads a column as the last column of this table says: **linear**;
**angle**, the shorter way round; **quaternion**, at constant rate (slerp); **hold**, the value of the
row before, as only what was known by then counts.
"""


def page() -> str:
    """The page, from `COLUMNS`."""
    lines = [
        INTRODUCTION,
        "| column | parts | unit | frame | what it is | between rows |",
        "|---|---|---|---|---|---|",
    ]
    for name, spec in COLUMNS.items():
        cells = [f"`{name}`", ", ".join(spec.parts), spec.unit, spec.frame, spec.doc, spec.interpolation]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join([*lines, "", ERRORS])


ERRORS = """Every error has an address, where all are known:

    b_total_nt = b_map_nt + b_disturbance_nt
    b_measured_nt = b_total_nt + b_model_error_nt + b_noise_nt
    b_truth_nt = |b_vector_nt|, and = b_total_nt of a physical magnetometer
"""


if __name__ == "__main__":
    (HERE / "columns.md").write_text(page(), encoding="utf-8")
