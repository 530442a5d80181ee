"""The zoo's table: what is wrong with a row, the summary, and Markdown."""

import re

MOST_CREEP_M = 0.005
"""A robot is at rest if no link moves by more in a second [m]."""

MOST_SPEED_M_S = 20.0
"""A link that is faster was thrown [m/s]."""

MASS_SHARE, LINK_M, BOX_SHARE = 0.01, 1e-5, 1e-3
"""Largest error of mass; of a link's place [m]; of the box of all visuals, relative to its diagonal."""

MOTION = 0.5, 1.5
"""Share of a commanded motion that counts as followed."""

BEGIN, END = "<!-- zoo: begin -->", "<!-- zoo: end -->"

ENGINES = ("newton", "physx")

TIPPED_DEG = 30.0
"""A robot that ends with a larger tilt has tipped over [deg]."""


def faults(row: dict) -> list[str]:
    """What is wrong with a robot, one text each."""
    texts = [f"{step}: {text}" for step, text in row.get("steps_failed", {}).items() if step != "yourdfpy"]
    for name, errors in row.get("errors", {}).items():
        if errors:
            texts.append(f"{name}: {len(errors)} errors, such as {errors[0]}")
    if row.get("link_error_m", 0.0) > LINK_M:
        texts.append(f"links differ from yourdfpy's by {row['link_error_m']:.2g} m")
    if row.get("box_error", 0.0) > BOX_SHARE:
        texts.append(f"box differs from yourdfpy's by {100 * row['box_error']:.2g} %")
    for engine in ENGINES:
        if engine in row:
            texts += [f"{engine}: {text}" for text in trial_faults(row[engine], row)]
    return texts


def trial_faults(seen: dict, row: dict) -> list[str]:
    """What is wrong in an engine."""
    if "failed" in seen:
        return [seen["failed"]]
    texts = []
    mass = row.get("urdf_mass_kg", row["mass_kg"])
    if mass and abs(seen["mass_kg"] / mass - 1) > MASS_SHARE:
        texts.append(f"weighs {seen['mass_kg']:.4g} kg, the URDF {mass:.4g} kg")
    if (seen.get("fk_error_m") or 0.0) > 1e-4:
        texts.append(f"links are {seen['fk_error_m']:.2g} m from where yourdfpy puts them")
    if not seen["finite"]:
        return [*texts, "explodes"]
    if seen["top_speed_m_s"] > MOST_SPEED_M_S:
        texts.append(f"is thrown at {seen['top_speed_m_s']:.0f} m/s")
    if seen["creep_m"] > MOST_CREEP_M:
        texts.append(f"creeps {1e3 * seen['creep_m']:.0f} mm/s ({seen['creeps'].rpartition('/')[2]})")
    motion = seen.get("motion")
    if motion and not row.get("meshes_absent") and not MOTION[0] <= motion["share"] <= MOTION[1]:
        texts.append(f"{motion['what']}: {100 * motion['share']:.0f} % of the commanded motion")
    return texts


def summary(rows: list[dict]) -> str:
    """One line."""
    converted = [r for r in rows if "convert_cpu_s" in r]
    good = [r for r in rows if not faults(r)]
    return f"{len(rows)} robots: {len(converted)} converted, {len(good)} without a fault"


def replaced(text: str, rows: list[dict]) -> str:
    """A page with the table between its marks."""
    before, _, rest = text.partition(BEGIN)
    after = rest.partition(END)[2]
    return f"{before}{BEGIN}\n{markdown(rows)}\n{END}{after}"


def markdown(rows: list[dict]) -> str:
    """The summary, the table, and the list of faults."""
    lines = [
        f"{summary(rows)}.",
        "",
        "| robot | kind | description | links | mass, kg | rules | at rest: creep, mm | motion | remarks |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    lines += [_line(row) for row in rows]
    lines += ["", "## What is wrong", ""]
    bad = [(row["name"], text) for row in rows for text in faults(row)]
    lines += [f"- {name}: {_plain(text)}" for name, text in bad] or ["Nothing."]
    return "\n".join(lines)


def _line(row: dict) -> str:
    where = f"`{row['source']}` {row['commit'][:10]}, `{row['path']}`"
    if "convert_cpu_s" not in row:
        return f"| {row['name']} | {row['kind']} | {where} | | | | | | not converted |"
    count = sum(map(len, row.get("errors", {}).values()))
    rules = "not run" if "errors" not in row else "passed" if not count else f"{count} errors"
    seen = next((row[engine] for engine in ENGINES if engine in row), {})
    creep = f"{1e3 * seen['creep_m']:.2f}" if "creep_m" in seen else "failed" if seen else ""
    motion = seen.get("motion")
    share = f"{motion['what']}: {100 * motion['share']:.0f} %" if motion else ""
    mass = f"{seen['mass_kg']:.4g}" if "mass_kg" in seen else f"{row['mass_kg']:.4g}"
    remarks = []
    if row["meshes_absent"]:
        remarks.append(f"meshes absent: {row['meshes_absent']}")
    if row["repairs"]:
        remarks.append("repaired: " + ", ".join(f"{kind} {count}" for kind, count in row["repairs"].items()))
    if "yourdfpy" in row.get("steps_failed", {}):
        remarks.append("yourdfpy refuses it")
    if seen.get("floats") and seen.get("tilt_deg", 0.0) > TIPPED_DEG:
        remarks.append("tips over")
    cells = [row["name"], row["kind"], where, row["links"], mass, rules, creep, share, "; ".join(remarks)]
    return f"| {' | '.join(map(str, cells))} |"


def _plain(text: str) -> str:
    """A text without the folders of this machine."""
    return re.sub(r"/\S*/(?=[^/\s]+\+[^/\s]+/)", "", text)
