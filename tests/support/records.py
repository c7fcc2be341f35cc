"""The parameter record of an adult, to be changed field by field."""

import struct

from jaxik.record import FLOAT_NAMES, Record

ADULT = {  # gains per tick at 30 Hz
    "originalGroundHeightMS": 0.0,
    "minAnkleHeightMS": -0.30,
    "maxAnkleHeightMS": 0.55,
    "cosineMaxKneeAngle": -0.990,
    "cosineMinKneeAngle": 0.766,
    "footPlantedAnkleHeightMS": 0.10,
    "footRaisedAnkleHeightMS": 0.16,
    "raycastDistanceUp": 0.50,
    "raycastDistanceDown": 0.80,
    "footEndLS_X": 0.0,
    "footEndLS_Y": -0.07,
    "footEndLS_Z": 0.20,
    "maxFootPitchRadians": 0.52,
    "minFootPitchRadians": -0.79,
    "maxFootRollRadians": 0.26,
    "minFootRollRadians": -0.52,
    "heightOffsetLimit": 0.30,
    "heightOffsetOnGain": 0.225,
    "heightOffsetOffGain": 0.116,
    "forwardUndulationRate": -0.30,
    "sideUndulationRate": -0.10,
    "forwardUndulationRateSlide": 0.80,
    "sideUndulationRateSlide": 0.60,
    "undulationGain": 0.19,
    "undulationGainSlide": 0.294,
    "undulationGainDefaultToSlide": 0.226,
    "undulationGainSlideToDefault": 0.135,
    "lockedDisableMinAngle": 50.0,
    "lockedDisableMaxAngle": 172.0,
    "lockedDisableDirAngle": 25.0,
    "nextLockFactorThreshold": 0.20,
}


def packed(**changes: float) -> Record:
    """The adult's record with some floats changed."""
    values = ADULT | changes
    return Record(floats=tuple(struct.pack("<f", values[name]) for name in FLOAT_NAMES))
