"""Quantities: the names and units by which columns are known, whatever wrote the table.

One table for surveys, paths and commands, in English, German, French, Spanish and Italian. To read another
word, add it here, in lower case and without accents.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

LENGTHS = {
    **dict.fromkeys(("m", "metre", "meter", "metres", "meters", "metros", "metri"), 1.0),
    "cm": 0.01,
    "mm": 0.001,
    "km": 1e3,
    "ft": 0.3048,
    "inch": 0.0254,
}
"""Metres per unit of length."""

DEGREES = ("deg", "degree", "degrees", "grad", "degres", "grados", "gradi", "dd")
ANGLES = {**dict.fromkeys(("rad", "radian", "radians"), 1.0), **dict.fromkeys(DEGREES, math.pi / 180)}
"""Radians per unit of angle."""

TIMES = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nanosecond", "nanoseconds"), 1e-9),
    "min": 60.0,
    "h": 3600.0,
}
"""Seconds per unit of time."""

FIELDS = {
    **dict.fromkeys(("nt", "nanotesla", "nanoteslas", "gamma", "gammas"), 1.0),
    **dict.fromkeys(("ut", "microtesla", "microteslas"), 1e3),
    "mt": 1e6,
    **dict.fromkeys(("t", "tesla"), 1e9),
    **dict.fromkeys(("mg", "milligauss"), 1e2),
    **dict.fromkeys(("g", "gauss"), 1e5),
}
"""nT per unit of the magnetic field."""

CLOCKWISE = (3,)  # Places among the names of a heading of those that count clockwise from north

SPEEDS = {
    **dict.fromkeys(("m_s", "mps", "m_s_1"), 1.0),
    **dict.fromkeys(("mm_s", "mmps", "mm_s_1"), 1e-3),
    **dict.fromkeys(("cm_s", "cmps", "cm_s_1"), 1e-2),
    **dict.fromkeys(("km_h", "kmh", "kmph", "kph"), 1 / 3.6),
}
"""m/s per unit of speed, with a low line for the stroke."""

RATES = {
    **dict.fromkeys(("rad_s", "radps", "rad_s_1"), 1.0),
    **dict.fromkeys(("deg_s", "degps", "dps", "deg_s_1"), math.pi / 180),
}
"""rad/s per unit of a turn's rate."""

IN_BRACKETS = frozenset({"t", "g", "min", "h"})
"""Units that are read in brackets only: `b_t` may be the total, and `t_min` the least."""


@dataclass(frozen=True)
class Quantity:
    """What a column may hold."""

    # Its names, the usual one first, in lower case with low lines between words, and `|` between equals.
    # Those of one place belong together in quantities of one kind, as easting and northing.
    names: str
    units: Mapping[str, float]  # Factors to SI units or nT, by unit in lower case
    beside: str = ""  # Words before or behind a name that say where it comes from

    @cached_property
    def around(self) -> frozenset[str]:
        """The words of `beside`."""
        return frozenset(self.beside.split())

    @cached_property
    def places(self) -> dict[str, int]:
        """Places in `names` by single name."""
        several = list(enumerate(self.names.split()))
        return {one: k for k, names in reversed(several) for one in names.split("|")}


_AT = (
    "p t pos position pose point coord wp map world base robot rs r utm local coordinate koordinate "
    "coordonnee coordenada coordinata proj stage gantry axis grid site"
)
_ON_EARTH = "location gps gnss geo wgs84 pos position decimal dd"
_READINGS = "strength value reading raw sensor measured calibrated avg mean corrected cor"
_SENT = "twist cmd vel msg data header"
_VECTORS = (
    "b{} b_{} m{} mag_{} mag{} field_{} magnetic_field_{} mag_field_{} magnetometer_{} magnetfeld_{} "
    "feld_{} champ_{} campo_{} champ_magnetique_{} campo_magnetico_{} flux_{} raw_mag_{} mag_raw_{}"
)

QUANTITIES: dict[str, Quantity] = {
    "x": Quantity(
        "x easting|eastings east rechtswert e px posx xpos tx ostwert est|ost este abscisse ascissa",
        LENGTHS,
        _AT,
    ),
    "y": Quantity(
        "y northing|northings north hochwert n py posy ypos ty nordwert nord norte ordonnee ordinata",
        LENGTHS,
        _AT,
    ),
    "lon": Quantity("lon|lng|long|longitude|lange|laenge|langengrad|longitud|longitudine", ANGLES, _ON_EARTH),
    "lat": Quantity("lat|latitude|breite|breitengrad|latitud|latitudine", ANGLES, _ON_EARTH),
    "heading": Quantity("heading yaw theta azimuth|azimut|bearing|compass|rumbo|kurs", ANGLES, _AT),
    "t": Quantity(
        "t time timestamp stamp seconds_elapsed elapsed time_since_start times seconds elapsed_time "
        "zeit uhrzeit zeitstempel temps heure horodatage tiempo hora tempo ora datetime date_time utc "
        "utc_time gps_time epoch relative_time x_value|elapsed_s rx|rx_time|receive_time|host_time|pc_time "
        "fecha_hora",
        TIMES,
        _SENT,
    ),
    "field": Quantity(
        "field b_nt scalar_mag magnitude b_measured b_total b_ut absolute_field b b_tot btotal bt b_t "
        "b_mag b_abs bmag mag total total_field mag_total magnetic_field mag_field tmi mag_tmi f "
        "feldstarke feldstaerke gesamtfeld totalfeld magnetfeld totalintensitat flussdichte intensitat "
        "champ champ_total champ_magnetique champ_magnetique_total intensite module campo campo_total "
        "campo_magnetico campo_magnetico_total intensidad modulo campo_totale intensita "
        "intensita_totale intensidad_total intensite_totale nt ut total_intensity "
        "total_magnetic_intensity magnetic_intensity flux_density mag1 magnetic_flux_density "
        "total_magnetic_field raw_mag mag_raw mag_1 mag_1_uc absolute_magnetic_field intensity "
        "strength field_strength scalar magnetic_rotation_sensor magnetometer tfm tmf "
        "magnetic magnetics mag_value total_magnetic_flux_density sensor_1 top_rdg reading_1 reading|rdg "
        "lettura messwert lecture lectura",
        FIELDS,
        _READINGS,
    ),
    **{f"b{axis}": Quantity(_VECTORS.replace("{}", axis), FIELDS) for axis in "xyz"},
    "v": Quantity(
        "v v_cmd cmd_v vx v_x linear linear_x lin lin_x lin_vel v_lin linear_velocity "
        "linear_velocity_x linear_speed speed velocity vel vel_x velocity_x forward forward_speed "
        "forward_velocity",
        SPEEDS,
        _SENT,
    ),
    "w": Quantity(
        "w w_cmd cmd_w wz w_z omega omega_z angular angular_z ang ang_z ang_vel w_ang angular_velocity "
        "angular_velocity_z angular_speed yaw_rate yawrate yaw_speed turn_rate turn rotation_rate",
        RATES,
        _SENT,
    ),
}
"""Quantities by the symbol that programs use."""

UNITS = frozenset(unit for quantity in QUANTITIES.values() for unit in quantity.units)  # All units
