"""Joint centres of HumanEva from the segments that its motion capture fits to the markers.

Every segment X of Vicon's body model comes as four points: its origin XO, and XP, XA and XL along its
axes z (towards the body's middle), x (forward) and y (left). The corrections are those of the data
set's own tools, which its published errors are measured with: the pelvis 5 cm further back, the
torso and the upper arms tilted by half a thickness.
"""

from collections.abc import Mapping

import numpy as np

from torchpose.errors import FileFormatError

__all__ = ["SHOULDER_OFFSETS", "joint_centres"]

SHOULDER_OFFSETS = ("LShoulderOffset", "RShoulderOffset")

_PELVIS_BACK = 50.0  # mm
_HEAD_LENGTH = 316.103  # mm, from the thorax
_SEGMENTS = ("PEL", "TRX", "HED", "LFE", "LTI", "RFE", "RTI", "LHU", "LRA", "RHU", "RRA")
_ORIGINS = ("LCLO", "RCLO", "LFEP", "RFEP")
_TINY = 1e-9


def joint_centres(points: Mapping[str, np.ndarray], measures: Mapping[str, float]) -> np.ndarray:
    """Return the fifteen joints of HumanEva [S, 15, 3], mm; NaN in frames in which a segment is lost.

    Args:
        points: [S, 3] by label, mm, NaN where lost. measures: ``shoulders`` (half the width, mm) and
            `SHOULDER_OFFSETS` of the person; what is missing is not corrected for.

    Raises:
        FileFormatError: a segment is not among the points.
    """
    wanted = {f"{s}{axis}" for s in _SEGMENTS for axis in "OPAL"} | set(_ORIGINS)
    missing = sorted(wanted - points.keys())
    if missing:
        raise FileFormatError(
            f"expected the segments of Vicon's body model among the points; {', '.join(missing[:8])} "
            f"are not among {', '.join(sorted(points)[:12])}"
        )
    pelvis, thorax = _trunk(points, measures.get("shoulders", 0.0))
    head = points["TRXO"] + _HEAD_LENGTH * _axis(points, "HED", "P")
    joints = [pelvis, thorax]
    for side, key in zip("LR", SHOULDER_OFFSETS, strict=True):
        joints += _arm(points, side, measures.get(key, 0.0))
    for side in "LR":
        joints += _leg(points, side)
    whole = np.stack([*joints, head], 1)
    lost = np.isnan(whole).any((1, 2), keepdims=True)
    return np.where(lost, np.nan, whole)


def _axis(points: Mapping[str, np.ndarray], segment: str, axis: str) -> np.ndarray:
    """Return the unit vector [S, 3] of a segment's axis: P is z, A is x, L is y."""
    vector = points[f"{segment}{axis}"] - points[f"{segment}O"]
    return vector / np.maximum(_length(vector), _TINY)


def _length(vector: np.ndarray) -> np.ndarray:
    return np.linalg.norm(vector, axis=-1, keepdims=True)


def _trunk(points: Mapping[str, np.ndarray], shoulders: float) -> tuple[np.ndarray, np.ndarray]:
    x, z = _axis(points, "PEL", "A"), _axis(points, "PEL", "P")
    length = _length(points["TRXO"] - points["PELO"])
    tilt = np.arctan2(shoulders / 2, length)
    pelvis = points["PELO"] - _PELVIS_BACK * x
    upper = pelvis + length * (np.cos(tilt) * z - np.sin(tilt) * x)
    return pelvis, (upper + points["TRXO"]) / 2


def _arm(points: Mapping[str, np.ndarray], side: str, offset: float) -> list[np.ndarray]:
    """Return the shoulder, elbow (the mean of where both bones have it) and wrist."""
    shoulder, elbow, wrist = points[f"{side}CLO"], points[f"{side}HUO"], points[f"{side}RAO"]
    upper, lower = _length(elbow - shoulder), _length(wrist - elbow)
    tilt = np.arctan2(offset / 2, upper)
    x, z = (_axis(points, f"{side}HU", a) for a in "AP")
    beside = elbow - (shoulder - upper * z)
    end = shoulder - upper * (np.cos(tilt) * z + np.sin(tilt) * x)
    start = end + beside
    x, z = (_axis(points, f"{side}RA", a) for a in "AP")
    hand = start - lower * (np.cos(tilt) * z - np.sin(tilt) * x)
    return [shoulder, (end + start) / 2, hand]


def _leg(points: Mapping[str, np.ndarray], side: str) -> list[np.ndarray]:
    """Return the hip, knee (the mean of where both bones have it) and ankle."""
    hip, knee, ankle = points[f"{side}FEP"], points[f"{side}FEO"], points[f"{side}TIO"]
    thigh = hip - _length(knee - hip) * _axis(points, f"{side}FE", "P")
    foot = knee - _length(ankle - knee) * _axis(points, f"{side}TI", "P")
    return [hip, (thigh + knee) / 2, foot]
