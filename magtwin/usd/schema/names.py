"""Names of the schema's attributes, and its version. Imports nothing, so that generate.py can load it alone.

The rule: `magtwin:<noun>:<field>`, in camel case, and last the unit of the value. Units that multiply follow
each other, `Per` comes before each that divides, and N m and A m2 count as one: nT/m is NtPerM, nT s/m is
NtSPerM, nT/(N m) is NtPerNm. A ratio, a count, a text and a file have none.
"""

VERSION = (1, 0)
"""Version of the schema: the first number changes with names and meanings, the second with new attributes."""

WITH_UNIT = {
    "anomalyMap": {
        "values": "valuesNt",
        "variance": "varianceNt2",
        "recordedYaw": "recordedYawRad",
        "origin": "originM",
        "cellSize": "cellSizeM",
        "headings": "headingsDeg",
    },
    "harmonic": {
        "pWorldDipole": "pWorldDipoleM",
        "mWorld": "mWorldAm2",
        "pBaseSensor": "pBaseSensorM",
    },
    "magnetometer": {
        "noiseDensityNt": "noiseDensityNtPerRootHz",
        "deadZoneAxis": "deadZoneAxisRad",
        "deadZonePlane": "deadZonePlaneRad",
        "gradientMaxNtM": "gradientMaxNtPerM",
        "gradientRelockNtM": "gradientRelockNtPerM",
        "vectorNoiseDensityNt": "vectorNoiseDensityNtPerRootHz",
        "vectorMisalignment": "vectorMisalignmentRad",
    },
    "imu": {
        "yawZero": "yawZeroRad",
        "tilt": "tiltRad",
        "levelError": "levelErrorRad",
        "tiltStd": "tiltStdRad",
        "orientationNoiseStd": "orientationNoiseStdRad",
        "gyroNoiseStd": "gyroNoiseStdRadPerS",
        "gyroBias": "gyroBiasRadPerS",
        "gyroBiasWalk": "gyroBiasWalkRadPerSPerRootS",
        "gyroVibration": "gyroVibrationRadPerM",
        "accelNoiseStd": "accelNoiseStdMPerS2",
        "accelVibration": "accelVibrationPerS",
    },
    "source": {"moment": "momentAm2", "magnetization": "magnetizationAPerM"},
    "lab": {"floor": "floorCornersM"},
    "wall": {"start": "startM", "end": "endM", "magnetization": "magnetizationAPerM"},
    "door": {"magnetization": "magnetizationAPerM"},
    "mocap": {"angleNoiseStd": "angleNoiseStdRad"},
    "plant": {
        "motorAbsNtNm": "motorAbsNtPerNm",
        "motorSquareNtNm2": "motorSquareNtPerNm2",
        "lidarSpeedNtSM": "lidarSpeedNtSPerM",
        "lidarSupplyNtA": "lidarSupplyNtPerA",
        "movingMoment": "movingMomentAm2",
        "pMagnetometerMoving": "pMagnetometerMovingM",
        "panRange": "panRangeRad",
        "currentDirectionStd": "currentDirectionStdRad",
    },
    "drive": {
        "vMax": "vMaxMPerS",
        "wMax": "wMaxRadPerS",
        "aMax": "aMaxMPerS2",
        "alphaMax": "alphaMaxRadPerS2",
        "wheelRateMax": "wheelRateMaxRadPerS",
        "slipS2M": "slipS2PerM",
        "localizationYawStd": "localizationYawStdRad",
        "odometryVNoiseStd": "odometryVNoiseStdMPerS",
        "odometryWNoiseStd": "odometryWNoiseStdRadPerS",
    },
    "platform": {
        "leftMotorNtNm": "leftMotorNtPerNm",
        "rightMotorNtNm": "rightMotorNtPerNm",
        "batteryNt": "batteryNtPerA",
        "lidarPhase": "lidarPhaseRad",
        "leftWheelMoment": "leftWheelMomentAm2",
        "leftWheelPhase": "leftWheelPhaseRad",
        "rightWheelMoment": "rightWheelMomentAm2",
        "rightWheelPhase": "rightWheelPhaseRad",
        "casterMoment": "casterMomentAm2",
        "casterPhase": "casterPhaseRad",
        "pBaseCaster": "pBaseCasterM",
    },
}
"""Names of noun's attributes whose field in Python leaves out the unit, or has it in another spelling.

The left one is the name of the field in camel case.
"""


def attribute_name(noun: str, field: str) -> str:
    """The attribute of a spec's field: ("drive", "wheel_radius_m") is `magtwin:drive:wheelRadiusM`."""
    first, *rest = field.split("_")
    name = first + "".join(word.capitalize() for word in rest)
    return f"magtwin:{noun}:{WITH_UNIT.get(noun, {}).get(name, name)}"


BESIDE = ("axis", "file", "primitive", "run", "sensor", "unconverted")
"""Second words of names that are none of the schema: the URDF converter, exports and runs author them."""
