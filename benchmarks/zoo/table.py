"""The zoo's table: what is wrong with a row, the summary, and Markdown."""

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
    if motion and not MOTION[0] <= motion["share"] <= MOTION[1]:
        texts.append(f"{motion['what']}: {100 * motion['share']:.0f} % of the commanded motion")
    return texts


def summary(rows: list[dict]) -> str:
    """One line."""
    converted = [r for r in rows if "convert_s" in r]
    good = [r for r in rows if not faults(r)]
    return f"{len(rows)} robots: {len(converted)} converted, {len(good)} without a fault"


def replaced(text: str, rows: list[dict]) -> str:
    """A page with the table between its marks."""
    before, _, rest = text.partition(BEGIN)
    after = rest.partition(END)[2]
    return f"{before}{BEGIN}\n{markdown(rows)}\n{END}{after}"


def markdown(rows: list[dict]) -> str:
    return ""
