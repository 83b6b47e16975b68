"""Networks that lift keypoints of one camera to joints: of single frames, and causal.

They are trained on all recordings of the persons of `clips.TRAINING`, each in the first camera of several
rings, and on those of `clips.KINECT_TRAINING` in the Kinect's place, with the detector's faults. Inputs are
rays relative to the median of those of the frame, in units of their extent, which of them are there and how
sure, that median and extent, and the frame rate. Outputs are joints relative to the pelvis in camera axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from benchmarks._lifters import Recurrent, draw_pieces, multilayer, train_lifter
from benchmarks.keypoint_bodies.clips import (
    KINECT_TRAINING,
    TRAINING,
    Clip,
    read_kinect,
    recorded,
    see,
)
from benchmarks.keypoint_bodies.scoring import Estimate
from torchpose.body import BODY_15
from torchpose.camera import CameraRig
from torchpose.priors._lifting_network import INPUTS, lifting_features
from torchpose.whole_body._keypoints.lifted_pose import place_on_rays

MLP, GRU, MEAN = "mlp", "gru", "mean-pose"
_STEPS, _FRAMES = 4_000, 48
_SEQUENCES = {MLP: 64, GRU: 32}
_RINGS, _KINECT_SEEDS, _LONGEST = 6, 3, 600  # of every recording; frames
_TARGET = 0.3  # metres
_JOINTS = len(BODY_15.names)
_PELVIS = BODY_15.joint("pelvis")


class Examples(NamedTuple):
    """Sequences of features and of joints relative to the pelvis in units of `_TARGET`.

    Attributes:
        seen: [T, F] of each. joints: [T, 15, 3] of each, camera axes, NaN where unknown.
    """

    seen: list[Tensor]
    joints: list[Tensor]

    def draw(self, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Return pieces of sequences, which are drawn by their length.

        Args:
            count: pieces. generator: of random numbers.
        """
        lengths = [len(x) for x in self.seen]
        weights = torch.tensor(lengths, dtype=torch.float32)
        pairs = list(draw_pieces(weights, lengths, _FRAMES, count, generator))
        return (torch.stack([self.seen[i][r] for i, r in pairs]),
                torch.stack([self.joints[i][r] for i, r in pairs]))  # fmt: skip


class BodyLifter:
    """Lifts keypoints of one camera.

    Args:
        net: from features [B, T, F] to joints [B, T, 45].
    """

    def __init__(self, net: nn.Module) -> None:
        self.net = net

    def __call__(
        self, rig: CameraRig, keypoints: Tensor, confidence: Tensor, fps: float
    ) -> Estimate:
        """Return joints in the axes of the room, put where they fit the keypoints.

        Args:
            rig: of one camera. keypoints: [T, 1, 15, 2]. confidence: [T, 1, 15]. fps: frames per second.
        """
        seen = features(rig, keypoints, confidence, fps)
        with torch.inference_mode():
            joints = self.net(seen[None])[0].unflatten(-1, (_JOINTS, 3)).double()
        return Estimate(placed(_TARGET * joints, rig, keypoints, confidence))


class MeanPose:
    """Has one pose, whatever it sees.

    Args:
        joints: [15, 3], relative to the pelvis, camera axes, metres.
    """

    def __init__(self, joints: Tensor) -> None:
        self.joints = joints

    def __call__(
        self, rig: CameraRig, keypoints: Tensor, confidence: Tensor, fps: float
    ) -> Estimate:
        """Return the mean pose in every frame; arguments as those of `BodyLifter`."""
        joints = self.joints.expand(len(keypoints), -1, -1)
        return Estimate(placed(joints, rig, keypoints, confidence))


def placed(
    joints: Float[Tensor, "T 15 3"], rig: CameraRig, keypoints: Float[Tensor, "T 1 15 2"],
    confidence: Float[Tensor, "T 1 15"],
) -> Float[Tensor, "T 15 3"]:  # fmt: skip
    """Return joints in the axes of the room, moved so that they lie near the rays of their keypoints.

    Args:
        joints: anywhere, camera axes. rig: of one camera. keypoints: pixels, undistorted.
        confidence: of a detector.
    """
    matrix = rig.matrix[0]
    rays = (keypoints[:, 0] - matrix[:2, 2]) / matrix.diagonal()[:2]
    weights = torch.where(rays.isfinite().all(-1), confidence[:, 0], 0)
    place = place_on_rays(joints, rays.nan_to_num(), weights)
    return (joints + place[:, None] - rig.translation[0]) @ rig.rotation[0]


def load_lifters(data: Path, file: Path | None, quick: bool) -> Mapping[str, BodyLifter | MeanPose]:
    """Return the mean pose and both networks, trained unless a file has them.

    Args:
        data: folder with the sets. file: for their weights, read if it is there, else written; None
            trains anew. quick: few recordings and steps, to see that it works.
    """
    torch.manual_seed(0)
    nets: dict[str, nn.Module] = {
        MLP: multilayer(INPUTS, 3 * _JOINTS),
        GRU: Recurrent(INPUTS, 3 * _JOINTS),
    }
    if file is not None and file.is_file():
        kept = load_file(file)
        for name, net in nets.items():
            net.load_state_dict(
                {k.removeprefix(name): v for k, v in kept.items() if k.startswith(name)}
            )
        mean = kept["mean"]
    else:
        examples = make_examples(data, quick)
        mean = torch.cat(examples.joints).nanmean(0)
        for name, net in nets.items():
            _train(net, name, examples, 2 if quick else _STEPS)
        if file is not None:
            weights = {f"{n}{k}": v for n, net in nets.items() for k, v in net.state_dict().items()}
            save_file({**weights, "mean": mean}, file)
    return {MEAN: MeanPose(_TARGET * mean.double())} | {
        name: BodyLifter(net.eval()) for name, net in nets.items()
    }


def make_examples(data: Path, quick: bool) -> Examples:
    """Return the recordings from which both networks learn.

    Args:
        data: folder with the sets. quick: one recording of each set in one ring.
    """
    pairs: list[tuple[Tensor, Tensor]] = []
    chosen = ("s01_a01_*_t1",) if quick else KINECT_TRAINING
    for seed in range(1, 2 if quick else 1 + _KINECT_SEEDS):
        pairs += [_example(clip) for clip in read_kinect(data, chosen, seed)]
    for folder, patterns in TRAINING.items():
        for i, clip in enumerate(recorded(data / folder, patterns, _LONGEST)):
            if quick and i:
                break
            for seed in range(1, 2 if quick else 1 + _RINGS):
                pairs.append(_example(see(clip, seed).of_cameras(1)))
    seen, joints = zip(*pairs, strict=True)
    return Examples(list(seen), list(joints))


def features(
    rig: CameraRig, keypoints: Float[Tensor, "T 1 15 2"], confidence: Float[Tensor, "T 1 15"],
    fps: float,
) -> Float[Tensor, "T F"]:  # fmt: skip
    """Return the inputs of the networks; see the module.

    Args:
        rig: of one camera. keypoints: pixels, undistorted. confidence: of a detector. fps: frames per
            second.
    """
    matrix = rig.matrix[0]
    rays = (keypoints[:, 0] - matrix[:2, 2]) / matrix.diagonal()[:2]
    return lifting_features(rays, confidence[:, 0], fps).float()


def _example(clip: Clip) -> tuple[Tensor, Tensor]:
    """Return features and targets of a clip in one camera."""
    local = (clip.joints - clip.joints[:, [_PELVIS]]) @ clip.rig.rotation[0].T
    return features(*clip.given), (local / _TARGET).float()


def _train(net: nn.Module, name: str, examples: Examples, steps: int, seed: int = 0) -> None:
    """Train a network on the mean distance of joints that are known."""
    generator = torch.Generator().manual_seed(seed)

    def loss() -> Tensor:
        seen, joints = examples.draw(_SEQUENCES[name], generator)
        off = net(seen).unflatten(-1, (_JOINTS, 3)) - joints.nan_to_num()
        known = joints.isfinite().all(-1)
        return (off.square().sum(-1) + 1e-6).sqrt()[known].mean()

    train_lifter(net, loss, steps, name)
