"""Tiny data sets in the formats of the real ones, animated by the demonstration's performer."""

import numpy as np
import torch

from torchpose.demo import performer
from torchpose.evaluation._unseen import poses_by_rate
from torchpose.learning import fit_upper_body_prior
from torchpose.skeleton import SKELETONS, UPPER_BODY

V1 = SKELETONS["kinect-v1-20"].joints


def poses(n_frames, seed):
    """[T, 8, 3], camera axes, another part of the performance for each seed."""
    start = 15 * seed
    return performer(start + n_frames, fps=30.0, seed=seed).body[start:].double()


def write_people(
    folder, persons=tuple(f"s{i}" for i in range(1, 9)), n_frames=30, n_sequences=1, first=0
):
    """Kinect v1 recordings of some persons, in Kinect axes; the first one is this one of all persons."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, person in enumerate(persons, first):
        for trial in range(n_sequences):
            body = poses(n_frames, 2 * number + trial).numpy()
            named = dict(zip(UPPER_BODY, np.moveaxis(body, 1, 0), strict=True))
            neck = named["neck"]
            joints = np.stack([_v1_joint(name, named, neck) for name in V1], 1)
            joints = joints * (-1.0, -1.0, 1.0) + (0.0, 0.0, 2.5)
            np.savez(
                folder / f"{person}_a01_t{trial}.npz", joints=joints.astype(np.float32),
                names=np.array(V1), fps=30.0, subject=person, action="demo",
                source="example/people@0:x",
            )  # fmt: skip
    return folder


def poses_to_score(recordings, prior, train, name=""):
    """All sequences that are scored, [T, 8, 3] each."""
    by_rate = poses_by_rate(recordings, prior, train, name)
    return [sequence for own in by_rate.values() for sequence in own]


def _v1_joint(name, named, neck):
    side, _, joint = name.partition("_")
    if side in ("left", "right") and f"{joint}_{side}" in named:
        return named[f"{joint}_{side}"]
    if side in ("left", "right") and joint == "wrist":
        return 0.8 * named[f"hand_{side}"] + 0.2 * named[f"elbow_{side}"]
    if name in ("head", "shoulder_center"):
        return named["head"] if name == "head" else neck
    sign = {"left": 1.0, "right": -1.0}.get(side, 0.0)
    down = {"spine": 0.3, "hip_center": 0.5, "hip": 0.5, "knee": 0.9, "ankle": 1.3, "foot": 1.35}
    depth = down[joint] if joint in down else down[name]
    return neck + np.array([0.1 * sign, depth, 0.0])


def write_one(folder, n_frames=60, seed=1):
    """A recording of the eight joints, in camera axes."""
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(
        folder / "kinect_joints.npz", joints=poses(n_frames, seed).numpy().astype(np.float32),
        names=np.array(UPPER_BODY), fps=30.0, subject="one", source="example/one",
    )  # fmt: skip
    return folder


def small_recipe(recordings, n_components=3, seed=0, progress=False, name=""):
    """A prior in a second, with noise of every kind that a recipe may bring."""
    prior = fit_upper_body_prior(
        recordings, n_components, seed, n_samples=1500, max_iter=15, name=name, progress=progress
    )
    from torchpose.upper_body._single_poses import default_process_cov

    prior.set_noise("process_cov", 2 * default_process_cov(prior))
    prior.set_noise("gamma", torch.full((n_components,), 0.9, dtype=torch.float64))
    prior.set_noise("calibration_scale_pose", torch.full((8,), 1.5, dtype=torch.float64))
    prior.set_noise("calibration_floor_pose", torch.full((8,), 1e-4, dtype=torch.float64))
    return prior
