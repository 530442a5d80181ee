"""The zoo's table: what is wrong with a row, the summary, and Markdown."""

import re

MOST_CREEP_M = 0.005
"""A robot is at rest if no link moves by more in a second [m]."""

MOST_CREEP_DEG = 0.5
"""And if its base turns by no more [deg]."""

MOST_SPEED_M_S = 20.0
"""A link that is faster was thrown [m/s]."""

MASS_SHARE, LINK_M, BOX_SHARE = 0.01, 1e-5, 1e-3
"""Largest error of mass; of a link's place [m]; of the box of all visuals, relative to its diagonal."""

MOTION = 0.5, 1.5
"""Share of a commanded motion that counts as followed."""

BEGIN, END = "<!-- zoo: begin -->", "<!-- zoo: end -->"

ENGINES = ("newton", "physx")

LEVEL_DEG, SUNK_M = 3.0, 0.005
"""A robot stands if its base tilts and sinks by no more from its authored place."""

FALLEN_DEG = 30.0
"""A robot whose base tilts by more has fallen over [deg]."""

STANDING = ("mobile", "mobile manipulator")
"""Kinds that must stand without a controller."""


def stance(seen: dict) -> str:
    """How a floating robot ends in an engine: "stands", or what it does instead; "" if it is fixed."""
    if not seen.get("floats") or "tilt_deg" not in seen:
        return ""
    tilt, sunk = seen["tilt_deg"], seen.get("base_sank_m", 0.0)
    if tilt > FALLEN_DEG:
        return f"falls over ({tilt:.0f} deg)"
    if tilt > LEVEL_DEG:
        return f"leans {tilt:.1f} deg"
    return "stands" if sunk <= SUNK_M else f"sinks {1e3 * sunk:.0f} mm"


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
    if seen.get("base_creep_m", 0.0) > MOST_CREEP_M or seen.get("tilt_creep_deg", 0.0) > MOST_CREEP_DEG:
        texts.append(f"does not come to rest: {1e3 * seen['base_creep_m']:.0f} mm/s")
    if row.get("kind") in STANDING and stance(seen) not in ("", "stands"):
        texts.append(stance(seen))
    motion = seen.get("motion")
    if motion and not on_boxes(row, seen) and not MOTION[0] <= motion["share"] <= MOTION[1]:
        texts.append(f"{motion['what']}: {100 * motion['share']:.0f} % of the commanded motion")
    return texts


def on_boxes(row: dict, seen: dict) -> list[str]:
    """Links that touch the floor with a placeholder for an absent collision mesh."""
    touching = {name.rpartition("/")[2] for name in seen.get("on_floor", ())}
    return [link for link in row.get("boxes", ()) if any(name.endswith(link) for name in touching)]


def summary(rows: list[dict]) -> str:
    """One line."""
    converted = [r for r in rows if "convert_cpu_s" in r]
    good = [r for r in rows if not faults(r)]
    text = f"{len(rows)} robots: {len(converted)} converted, {len(good)} without a fault"
    stances = [stance(row[engine]) for row in rows for engine in ENGINES[:1] if engine in row]
    floating = [s for s in stances if s]
    return f"{text}; {floating.count('stands')} of {len(floating)} that float stand" if floating else text


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
        "| robot | kind | description | links | mass, kg | rules | stance | creep, mm | motion | remarks |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    lines += [_line(row) for row in rows]
    lines += ["", "## What is wrong", ""]
    bad = [(row["name"], text) for row in rows for text in faults(row)]
    known = {row["name"]: row["known"] for row in rows if row.get("known")}
    lines += [f"- {name}: {_plain(text)}" for name, text in bad] or ["Nothing."]
    told = [f"- {name}: {known[name]}" for name in dict.fromkeys(name for name, _ in bad) if name in known]
    lines += ["", "The reasons:", "", *told] if told else []
    return "\n".join(lines)


def _line(row: dict) -> str:
    where = f"`{row['source']}` {row['commit'][:10]}, `{row['path']}`"
    if "convert_cpu_s" not in row:
        return f"| {row['name']} | {row['kind']} | {where} | | | | | | | not converted |"
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
    if on_boxes(row, seen):
        remarks.append(
            f"motion not judged: {', '.join(on_boxes(row, seen))} stands on a box for its absent mesh"
        )
    said = "; ".join(remarks)
    cells = [row["name"], row["kind"], where, row["links"], mass, rules, stance(seen), creep, share, said]
    return f"| {' | '.join(map(str, cells))} |"


def _plain(text: str) -> str:
    """A text without the folders of this machine."""
    return re.sub(r"/\S*/(?=[^/\s]+\+[^/\s]+/)", "", text)
