"""A small prior, keypoints and recordings of the animated performer, and the command in-process."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from torchpose import demo
from torchpose.cli import main
from torchpose.io import Keypoints, Recording, write_keypoints
from torchpose.learning import fit_upper_body_prior

N_FRAMES = 24
GAP = slice(15, 18)


@dataclass
class Result:
    """What a command printed, and its exit code."""

    code: int
    out: str
    err: str


@pytest.fixture
def torchpose(capsys):
    """The command: torchpose("track", path, "--out", folder) -> Result."""

    def run(*arguments: object) -> Result:
        capsys.readouterr()
        code = main([str(a) for a in arguments])
        printed = capsys.readouterr()
        return Result(code, printed.out, printed.err)

    return run


@pytest.fixture(scope="session")
def files(tmp_path_factory) -> Path:
    """prior.safetensors, keypoints.npz (head, neck, hands; K; a gap), recordings/p1.npz and p2.npz."""
    folder = tmp_path_factory.mktemp("cli")
    performances = [demo.performer(450, seed=seed) for seed in (1, 2)]
    recordings = [
        Recording(p.joints, p.names, 30.0, f"p{i}", "all", "site:set@1:file")
        for i, p in enumerate(performances, start=1)
    ]
    prior = fit_upper_body_prior(recordings, 4, seed=0, n_samples=3000, name="tiny")
    prior.save(folder / "prior.safetensors")
    (folder / "recordings").mkdir()
    for i, p in enumerate(performances, start=1):
        arrays = {"joints": p.joints.numpy(), "names": np.array(p.names), "fps": 30.0}
        np.savez(folder / "recordings" / f"p{i}.npz", subject=f"p{i}", axes="camera", **arrays)
    write_keypoints(folder / "keypoints.npz", keypoints())
    return folder


def keypoints(**changes) -> Keypoints:
    """The performer's keypoints with a gap of the right hand."""
    performance = demo.performer(N_FRAMES, seed=5)
    points = demo.noisy_keypoints(performance.joints, gap=None, seed=5)
    points[GAP, demo.KEYPOINT_NAMES.index("hand_right")] = torch.nan
    camera = demo.demo_camera()
    clip = Keypoints(points, demo.KEYPOINT_NAMES, None, 30.0, camera.matrix, camera.image_size)
    return replace(clip, **changes)
