"""People who bend over, worked out by hand: recordings of the fifteen joints of HumanEva."""

import numpy as np

from tests.benchmarks.walkers import NAMES

FPS = 30.0


def bender(n_bends=3, n_frames=24, depth=1.2, size=1.0, sway=0.1, seed=0):
    """Joints [T, 15, 3], y up, metres, facing +z: upright with the arms up, over, and up again."""
    t = np.arange(n_bends * n_frames + 1) / n_frames
    rng = np.random.default_rng(seed)
    phase = 0.5 - 0.5 * np.cos(2 * np.pi * t)
    lean = depth * phase
    waves = [sway * np.sin(2 * np.pi * k * t + rng.uniform(0, 6.3)) for k in (1, 2, 3, 1, 2, 3)]
    pelvis = np.stack([0 * t, 0.93 + 0 * t, -0.2 * np.sin(lean)], -1)
    points = {"pelvis": pelvis}
    points["thorax"] = pelvis + 0.5 * _up(lean)
    points["head"] = points["thorax"] + 0.2 * _up(lean + waves[0])
    for i, (side, sign) in enumerate((("left", 1.0), ("right", -1.0))):
        across = np.array([sign, 0.0, 0.0])
        shoulder = points["thorax"] + 0.18 * across - 0.06 * _up(lean)
        elbow = shoulder + 0.29 * _up(lean + 0.3 + waves[1 + i]) + 0.04 * across
        hip = pelvis + 0.09 * across
        knee = hip + 0.43 * -_up(-0.15 * phase + waves[3 + i] / 3)
        points |= {
            f"{side}_shoulder": shoulder, f"{side}_elbow": elbow,
            f"{side}_wrist": elbow + 0.25 * _up(lean + 0.6 + waves[5 - i]),
            f"{side}_hip": hip, f"{side}_knee": knee,
            f"{side}_ankle": knee + 0.42 * -_up(0.05 * phase + waves[5] / 3),
        }  # fmt: skip
    return size * np.stack([points[name] for name in NAMES], 1)


def squatter(n_frames=50):
    """Somebody who sways instead, arms hanging: another action."""
    joints = bender(1, n_frames - 1, 0.3, seed=9)
    swing = 0.3 * np.sin(np.arange(n_frames) / 4)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        shoulder = joints[:, NAMES.index(f"{side}_shoulder")]
        elbow = shoulder - 0.29 * _up(sign * swing)
        joints[:, NAMES.index(f"{side}_elbow")] = elbow
        joints[:, NAMES.index(f"{side}_wrist")] = elbow - 0.25 * _up(sign * swing)
    return joints


def _up(angle):
    """Unit vectors that point up, tilted forward by an angle."""
    return np.stack([0 * angle, np.cos(angle), np.sin(angle)], -1)


def write_benders(folder, persons=("p1", "p2", "p3", "p4"), others=("clap",)):
    """Two recordings of bends for every person, and one of each other action."""
    folder.mkdir(parents=True, exist_ok=True)
    for p, person in enumerate(persons):
        recordings = [
            ("bend", bender(3, 22 + 2 * p + 3 * trial, 1.1 + 0.05 * p, 1 + 0.03 * p, seed=10 * p + trial))
            for trial in range(2)
        ]  # fmt: skip
        recordings += [(action, squatter()) for action in others]
        for trial, (action, joints) in enumerate(recordings):
            np.savez(
                folder / f"{person}_{trial}_{action}.npz", joints=joints.astype(np.float32),
                names=np.array(NAMES), fps=FPS, subject=person, action=action, axes="y-up",
                source="example/benders",
            )  # fmt: skip
    return folder
