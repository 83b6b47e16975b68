"""People who walk along z, worked out by hand: recordings of the fifteen joints of HumanEva."""

import numpy as np

from torchpose.skeleton import SKELETONS

NAMES = SKELETONS["humaneva-15"].joints


def walker(n_frames, phase=0.0, size=1.0, speed=1.2, fps=60.0, period=1.0):
    """Joints [T, 15, 3], y up, metres: legs and arms swing, knees bend, facing +z."""
    t = np.arange(n_frames) / fps
    angle = 2 * np.pi * t / period + phase
    pelvis = np.stack([0 * t, 0.95 + 0.01 * np.cos(2 * angle), speed * t], -1)
    up = np.array
    points = {
        "pelvis": pelvis,
        "thorax": pelvis + up([0, 0.5, 0.03]),
        "head": pelvis + up([0, 0.7, 0.05]),
    }
    for side, sign in (("left", 1.0), ("right", -1.0)):
        swing = 0.45 * sign * np.sin(angle)
        bend = 0.5 + 0.45 * np.sin(angle + (0 if sign > 0 else np.pi) + 0.6)
        hip = pelvis + up([0.09 * sign, -0.02, 0])
        knee = hip + 0.43 * _down(swing)
        shoulder = points["thorax"] + up([0.18 * sign, -0.06, 0])
        elbow = shoulder + 0.29 * _down(-swing)
        points |= {
            f"{side}_hip": hip, f"{side}_knee": knee,
            f"{side}_ankle": knee + 0.42 * _down(swing - bend),
            f"{side}_shoulder": shoulder, f"{side}_elbow": elbow,
            f"{side}_wrist": elbow + 0.25 * _down(-swing + 0.4),
        }  # fmt: skip
    return size * np.stack([points[name] for name in NAMES], 1)


def _down(angle):
    """Unit vectors that hang down, turned forward by an angle."""
    return np.stack([0 * angle, -np.cos(angle), np.sin(angle)], -1)


def write_walkers(folder, persons=("p1", "p2"), n_trials=4, n_frames=70):
    """A common file for every trial, each with another phase and speed."""
    folder.mkdir(parents=True, exist_ok=True)
    for p, person in enumerate(persons):
        for trial in range(n_trials):
            joints = walker(
                n_frames, 0.7 * trial + p, 1 + 0.05 * p, 1.1 + 0.1 * trial, period=1 - 0.03 * trial
            )
            np.savez(
                folder / f"{person}_{trial}.npz", joints=joints.astype(np.float32),
                names=np.array(NAMES), fps=60.0, subject=person, action="walk", axes="y-up",
                source="example/walkers",
            )  # fmt: skip
    return folder
