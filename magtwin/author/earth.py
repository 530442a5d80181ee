"""The Earth's field from a text: a scene, a place and a date, or its components."""

from pathlib import Path

from magtwin.errors import InputError

FORMS = "a scene; latitude,longitude,height,date; or x,y,z in nT"


def earth_of(text: str) -> tuple[float, float, float]:
    """The Earth's field in world axes [nT].

    Args:
        text: A stage with an Earth field; "latitude,longitude,height,date" [deg, deg, m, YYYY-MM-DD], if the
            world's y is true north; or "x,y,z" in world axes [nT].

    Raises:
        InputError: The text has none of these forms, the scene has no Earth field, or the size is impossible.
    """
    words = [word.strip() for word in text.split(",")]
    if len(words) in (3, 4) and not Path(text).exists():
        from magtwin.field.sources.earth import earth_field_nt
        from magtwin.field.survey.readings import checked_earth_nt
        from magtwin.field.units import LEAST_USUAL_NT, MOST_USUAL_NT

        try:
            x, y, z = (float(word) for word in words[:3])
        except ValueError as error:
            raise InputError(f"`earth` is {FORMS}; got {text!r}", parameter="earth") from error
        if len(words) == 4:
            return earth_field_nt(x, y, z, words[3])
        size = sum(c * c for c in checked_earth_nt((x, y, z))) ** 0.5
        if not LEAST_USUAL_NT <= size <= MOST_USUAL_NT:
            way = "give it in nT, or as latitude,longitude,height,date"
            what = f"a field of {size:.6g} nT, and the Earth's is some 22,000 to 67,000"
            raise InputError(f"`earth={text}` is {what}; {way}", parameter="earth")
        return x, y, z
    from magtwin.usd.scene import read_scene

    if not Path(text).is_file():
        raise InputError(f"`earth` is {FORMS}; there is no file {text!r}", parameter="earth")
    earth = read_scene(text, check_network=False).earth
    if earth is None:
        raise InputError(f"`earth={text}`: this scene has no Earth field; give {FORMS}", parameter="earth")
    return earth.b_world_nt
