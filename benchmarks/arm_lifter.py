"""Fit the network that lifts arms, which comes with torchpose.

It sees pieces of recordings, with bones of other lengths, from cameras that are drawn anew for each piece:
turned by 15 degrees against the body (three in ten: by any angle) and tilted by 8, at 2.2 m within a factor
of 1.7. Half of the pieces have all joints, a third head, neck and hands, the others any of them. Joints
are missing for single frames, and in every second batch hands are wrists.

    python -m benchmarks.arm_lifter --data DIR --fit FILE.safetensors

The recordings are those of the prior over arms (`benchmarks.bones`), but for `LEFT_OUT` and
`LEFT_OUT_PERSONS`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from benchmarks import bones
from benchmarks._command import run_command
from benchmarks._lifters import FEW, ArmExamples, train_lifter
from torchpose.priors._arm_lifter import (
    JOINTS,
    ArmLifter,
    ArmLifterInfo,
    LiftedArms,
    arm_features,
    farthest_so_far,
    from_neck,
)
from torchpose.priors._arms import ArmPrior, shipped_arm_prior
from torchpose.skeleton._joint_sets import UPPER_BODY

LEFT_OUT, LEFT_OUT_PERSONS = "mocap_berkeley_mhad", {"kinect_utd_mhad": ("s7", "s8")}
"""Set and persons to whom the network is not fitted, so that they can be scored."""
_STEPS, _PIECES, _FRAMES, _SHOWN = 5_000, 48, 48, 12  # pieces of a step, their frames, those shown
_SEED = 0
_RATE = 30.0
_DEPTH, _DEPTH_STD, _NEAREST = 2.2, 0.55, 0.5
_NOISE, _NOISE_STD = 3.0 / 525.0, 0.5  # of a pixel over the focal length, and of its log
_WHOLE, _FEW, _HEADLESS, _KEPT = 0.5, 0.3, 0.3, 0.7  # shares of pieces; of joints of the others
_BLINKING, _BLINK = 0.3, 0.02  # shares of pieces and of frames in which joints are missing
_SPREAD_SHARE = 0.1  # of the loss
_UNIT = 0.2  # metres in which errors count
_ROWS = [UPPER_BODY.index(name) for name in JOINTS]
_NECK, _HEAD = UPPER_BODY.index("neck"), JOINTS.index("head")
_GIVEN_OF_FEW = torch.tensor([*FEW, *FEW, True])


def fit_without(
    data: Path,
    left_out: str | None,
    arms: ArmPrior,
    quick: bool = False,
    persons: Mapping[str, Sequence[str]] = MappingProxyType({}),
) -> ArmLifter:
    """Return a network that is fitted to all sets but one, and without some persons.

    Args:
        data: folder with the sets. left_out: name of a set, None for none. arms: whose lengths of bones
            are taken. quick: few recordings and steps, to see that it works.
        persons: of each set, those that are left out.
    """
    kept = {name: share for name, share in bones.SETS.items() if name != left_out}
    kept = dict([*kept.items()][1:2]) if quick else kept
    sets = []
    for name, share in kept.items():
        found = [r for r in bones.recordings(data / name) if r.person not in persons.get(name, ())]
        sets.append((share, bones.with_arms(found)))
    info = ArmLifterInfo(
        name="arms",
        recordings=tuple(name.split("/")[0] for name in kept),
        left_out=tuple(f"{name} {person}" for name in kept for person in persons.get(name, ())),
        licence="MIT; see the card for the recordings",
        command="python -m benchmarks.arm_lifter --data DIR --fit FILE.safetensors",
    )
    return fit_network(sets, arms, info, quick)


def fit_network(
    sets: Sequence[tuple[float, Sequence[Tensor]]],
    arms: ArmPrior,
    info: ArmLifterInfo | None = None,
    quick: bool = False,
) -> ArmLifter:
    """Return a network that is fitted to sets of recordings.

    Args:
        sets: share and joints [T, 8, 3] of each. arms: whose lengths of bones are taken. info: facts about
            the fit. quick: few steps, to see that it works.
    """
    torch.manual_seed(_SEED)
    network, draw = ArmLifter(info), _Examples(sets, arms)
    train_lifter(network, lambda: _loss(network, *draw()), 2 if quick else _STEPS, "arm lifter")
    return network.requires_grad_(False)


class _Examples:
    """Draws of features and arms: frames of arms in random cameras, with hands and with wrists in turns."""

    def __init__(self, sets: Sequence[tuple[float, Sequence[Tensor]]], arms: ArmPrior) -> None:
        self.generator = torch.Generator().manual_seed(_SEED)
        self.of_kind = [ArmExamples(sets, arms, kind, self.generator) for kind in ("hand", "wrist")]
        self.wrists = False

    def __call__(self) -> tuple[Float[Tensor, "N S F"], Float[Tensor, "N S 2 2 3"]]:
        """Return features, and elbows and hands from their shoulders in the axes of the camera, metres."""
        self.wrists = not self.wrists
        examples = self.of_kind[self.wrists]
        joints, arms = examples.bodies(_FRAMES, _PIECES)
        joints = joints + examples.place(_PIECES, _DEPTH, _DEPTH_STD, _NEAREST)[:, None, None]
        rays = joints[..., :2] / joints[..., 2:].clamp_min(0.2)
        noise = _NOISE * (_NOISE_STD * examples.normal(_PIECES, 1, 1, 1)).exp()
        rays = rays + noise * examples.normal(*rays.shape)
        ways = pad(rays, (0, 1), value=1.0)
        seen, axes = from_neck(ways[:, :, _ROWS].nan_to_num(), ways[:, :, _NECK])
        given = self._given() & rays[:, :, _ROWS].isfinite().all(-1)
        nobody = torch.zeros(_PIECES, len(JOINTS))
        farthest = farthest_so_far(seen, given, nobody, _RATE)
        features = arm_features(seen, given, farthest, self.wrists)
        ends = arms.cumsum(3) @ axes[:, :, None]
        shown = torch.randint(_FRAMES, (_PIECES, _SHOWN), generator=self.generator)
        piece = torch.arange(_PIECES)[:, None]
        return features[piece, shown], ends[piece, shown]

    def _given(self) -> Bool[Tensor, "N T J"]:
        """Return which joints are measured in each frame of the pieces."""
        kind, headless, blinking = self._uniform(3, _PIECES, 1)
        some = self._uniform(_PIECES, len(JOINTS)) < _KEPT
        given = torch.where(kind < _WHOLE + _FEW, _GIVEN_OF_FEW, some)
        given = torch.where(kind < _WHOLE, torch.ones_like(given), given)
        given[:, _HEAD] &= headless[:, 0] >= _HEADLESS
        blinks = self._uniform(_PIECES, _FRAMES, len(JOINTS)) < _BLINK
        return given[:, None] & ~(blinks & (blinking < _BLINKING)[:, None])

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator)


def _loss(network: ArmLifter, seen: Tensor, ends: Float[Tensor, "N S 2 2 3"]) -> Tensor:
    """Return what is to be small: errors of bones and of hands, and how unlikely they are."""
    lifted: LiftedArms = network(seen)
    off = (lifted.ends - ends) / _UNIT
    bones_off = torch.stack([off[..., 0, :], off[..., 1, :] - off[..., 0, :], off[..., 1, :]])
    each = (bones_off.square().sum(-1) + 1e-6).sqrt()
    log_std = (lifted.std / _UNIT).log()
    unlikely = 3 * log_std + off.detach().square().sum(-1) / (2 * (2 * log_std).exp())
    return each[:2].mean() + each[2].mean() + _SPREAD_SHARE * unlikely.mean()


def main(*, data: Path, fit: Path, threads: int = 2, quick: bool = False) -> None:
    """Fit the network and write it.

    Args:
        data: folder with the sets.
        fit: file of the network.
        threads: cores.
        quick: few recordings and steps, to see that it works.
    """
    torch.set_num_threads(threads)
    fit_without(data, LEFT_OUT, shipped_arm_prior(), quick, LEFT_OUT_PERSONS).save(fit)


if __name__ == "__main__":
    run_command(main)
