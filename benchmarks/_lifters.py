"""Learned lifters of arms beside the trackers of `bones`: nearest neighbour, MLP and causal GRU.

They are trained on the sets that the prior over arms is fitted to, with its shares, in as many cameras
and sizes as that prior allows: arms as recorded, lengths of bones drawn from the prior over persons, turns
of 15 degrees (three in ten: any), tilts of 8, distances of 2.6 m within a factor of 1.5, and the
noise of the test. Inputs are rays relative to the neck, in units of the largest extent so far, the extents
themselves, and which joints are given; half of the training examples have all joints, the others those of
the small set. Targets are the vectors of both bones of both arms in camera axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn.functional import normalize
from tqdm.auto import tqdm

from torchpose.math import euler_to_matrix
from torchpose.priors._arms import LENGTHS, ArmPrior
from torchpose.skeleton._upper_body import LEFT_ARM, RIGHT_ARM, mirror_pose

__all__ = [
    "FEW",
    "LIFTERS",
    "ArmExamples",
    "Lifter",
    "Recurrent",
    "draw_pieces",
    "fit_lifter",
    "multilayer",
    "train_lifter",
]

LIFTERS = ("nearest neighbour", "MLP", "GRU, causal")
_BONES = 12  # numbers: two bones of two arms
_SEED = 0  # of samples and start
_STEPS, _SEQUENCES, _FRAMES, _WIDTH = 4_000, 32, 48, 128
_NEIGHBOURS = 60_000  # frames that are kept
_TARGET = 0.2  # metres
_TURN, _TILT, _ANY = math.radians(15.0), math.radians(8.0), 0.3
_DEPTH, _DEPTH_STD, _NEAREST = 2.6, 0.4, 0.9
_ASIDE = 0.2  # of the depth
_NOISE = 3.0 / 525.0  # of a pixel over the focal length
FEW = (False, False, True)  # of shoulder, elbow and hand
_ARMS = [list(LEFT_ARM[2::-1]), list(RIGHT_ARM[2::-1])]  # shoulder, elbow and hand


class Lifter(NamedTuple):
    """What turns rays into arms.

    Attributes:
        net: from features [B, T, F] to bones [B, T, 12], None of the nearest neighbour.
        known: features and bones of the neighbour, [N, F] and [N, 12]; None of a net.
    """

    net: nn.Module | None = None
    known: tuple[Tensor, Tensor] | None = None

    def __call__(
        self, rays: Float[Tensor, "T 2 3 2"], neck: Float[Tensor, "T 2"], given: Bool[Tensor, " 3"]
    ) -> Float[Tensor, "T 2 2 3"]:
        """Return upper arms and forearms, metres.

        Args:
            rays: of shoulders, elbows and hands, left and right, over the focal length. neck: its ray.
            given: which of the three are measured.
        """
        seen = _features(rays[None].float(), neck[None].float(), given.expand(1, 3))
        if self.net is not None:
            with torch.inference_mode():
                bones = self.net(seen)[0]
        else:
            known, targets = self.known or (seen[0], seen[0])
            rows = torch.cat([torch.cdist(part, known).argmin(1) for part in seen[0].split(256)])
            bones = targets[rows]
        return _TARGET * bones.double().unflatten(-1, (2, 2, 3))


class Recurrent(nn.Module):
    """Two causal layers of gated recurrent units, and a linear one.

    Args:
        n_inputs, n_outputs: of each frame.
    """

    def __init__(self, n_inputs: int, n_outputs: int = _BONES) -> None:
        super().__init__()
        self.cells = nn.GRU(n_inputs, _WIDTH, 2, batch_first=True)
        self.out = nn.Linear(_WIDTH, n_outputs)

    def forward(self, seen: Float[Tensor, "B T F"]) -> Float[Tensor, "B T O"]:
        """Return what the features of every frame and those before it stand for."""
        out: Tensor = self.out(self.cells(seen)[0])
        return out


def fit_lifter(
    kind: str,
    sets: Sequence[tuple[float, Sequence[Tensor]]],
    arms: ArmPrior,
    hand: str,
    quick: bool,
) -> Lifter:
    """Return a lifter that was trained on sets of recordings.

    Args:
        kind: one of `LIFTERS`. sets: share and joints [T, 8, 3] of each. arms: whose lengths of bones are
            taken. hand: "hand" or "wrist", where forearms end.
        quick: few steps, to see that it works.
    """
    generator = torch.Generator().manual_seed(_SEED)
    torch.manual_seed(_SEED)
    draw = _Examples(sets, arms, hand, generator)
    if kind == LIFTERS[0]:
        rounds = range(2 if quick else _NEIGHBOURS // (_SEQUENCES * _FRAMES))
        seen, bones = zip(
            *(draw(frames=1, count=_SEQUENCES * _FRAMES) for _ in rounds), strict=True
        )
        return Lifter(known=(torch.cat(seen)[:, 0], torch.cat(bones)[:, 0]))
    n_inputs = draw(frames=1, count=1)[0].shape[-1]
    net: nn.Module = Recurrent(n_inputs) if kind == LIFTERS[2] else multilayer(n_inputs)

    def loss() -> Tensor:
        seen, bones = draw(_FRAMES, _SEQUENCES)
        off = (net(seen) - bones).unflatten(-1, (2, 2, 3))
        each, whole = (x.square().sum(-1) + 1e-6 for x in (off, off.sum(-2)))
        return each.sqrt().mean() + whole.sqrt().mean()

    return Lifter(train_lifter(net, loss, 2 if quick else _STEPS, kind))


def train_lifter(
    net: nn.Module, loss: Callable[[], Tensor], steps: int, name: str, rate: float = 2e-3
) -> nn.Module:
    """Return a net after so many steps of AdamW, for evaluation.

    Args:
        net: to be trained. loss: of a new batch. steps: number of batches. name: on the bar.
        rate: of learning, the largest.
    """
    optimiser = torch.optim.AdamW(net.parameters(), lr=rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=steps)
    for _ in tqdm(range(steps), desc=name):
        optimiser.zero_grad()
        loss().backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        schedule.step()
    return net.eval()


def multilayer(n_inputs: int, n_outputs: int = _BONES) -> nn.Module:
    """Return a net of two hidden layers."""
    return nn.Sequential(
        nn.Linear(n_inputs, 512), nn.ReLU(), nn.Linear(512, 512), nn.ReLU(),
        nn.Linear(512, n_outputs),
    )  # fmt: skip


def draw_pieces(
    weights: Float[Tensor, " N"],
    lengths: Sequence[int],
    frames: int,
    count: int,
    generator: torch.Generator,
) -> Iterator[tuple[int, Int[Tensor, " T"]]]:
    """Yield which sequence a random piece is of, and its frames; short ones end in their last frame.

    Args:
        weights: by which sequences are drawn, of any sum. lengths: of the sequences.
        frames: of a piece. count: number of pieces. generator: of random numbers.
    """
    for i in torch.multinomial(weights, count, True, generator=generator).tolist():
        first = int(torch.randint(max(1, lengths[i] - frames), (1,), generator=generator))
        yield i, (first + torch.arange(frames)).clamp_max(lengths[i] - 1)


class ArmExamples:
    """Draws of arms in random cameras.

    Args:
        sets: share and joints [T, 8, 3] of each set. arms: whose lengths of bones are taken.
        hand: "hand" or "wrist", where forearms end. generator: of random numbers.
    """

    def __init__(
        self,
        sets: Sequence[tuple[float, Sequence[Tensor]]],
        arms: ArmPrior,
        hand: str,
        generator: torch.Generator,
    ) -> None:
        self.generator = generator
        self.pool = [joints.float() for _, found in sets for joints in found]
        lengths = [torch.tensor([float(len(x)) for x in found]) for _, found in sets]
        self.weight = torch.cat(
            [share * n / n.sum() for (share, _), n in zip(sets, lengths, strict=True)]
        )
        forearm = "forearm" if hand == "wrist" else "forearm_to_hand"
        chosen = [LENGTHS.index(name) for name in ("upper_arm", forearm, "shoulder_width")]
        self.lengths, self.spread = arms.lengths[chosen].float(), arms.spread[chosen].float()

    def bodies(self, frames: int, count: int) -> tuple[Tensor, Tensor]:
        """Return joints [N, T, 8, 3] and bones [N, T, 2, 2, 3], turned, metres.

        Joints are relative to the middle of the shoulders. Head and neck are as far away, in shoulder
        widths, as they were recorded.
        """
        joints = self._mirrored(self._drawn(frames, count))
        arms = joints[:, :, _ARMS]
        scale = (self.spread.min() * self.normal(count, 1)).exp()
        own = (self.spread.square() - self.spread.min().square()).sqrt() * self.normal(count, 3)
        sizes = self.lengths * scale * own.exp()
        joints = joints - arms[:, :, :, :1].mean(2)
        width = (arms[:, :, 0, 0] - arms[:, :, 1, 0]).norm(dim=-1).median(1).values
        joints = joints * (sizes[:, 2] / width.clamp_min(0.05))[:, None, None, None]
        bones = normalize(arms.diff(dim=3), dim=-1) * sizes[:, None, None, :2, None]
        turn = self._turns(count)
        joints, bones = (torch.einsum("nij,n...j->n...i", turn, x) for x in (joints, bones))
        ends = joints[:, :, _ARMS][:, :, :, :1] + bones.cumsum(3)
        joints[:, :, [rows[1:] for rows in _ARMS]] = ends
        return joints, bones

    def place(
        self, count: int, depth: float, depth_std: float, nearest: float
    ) -> Float[Tensor, "N 3"]:
        """Return places of bodies before the camera, metres.

        Args:
            count: of bodies. depth, depth_std: median, and standard deviation of its log. nearest: the least.
        """
        far = (depth * (depth_std * self.normal(count)).exp()).clamp_min(nearest)
        aside = _ASIDE * self.normal(count, 2)
        return torch.cat([aside, torch.ones(count, 1)], 1) * far[:, None]

    def normal(self, *shape: int) -> Tensor:
        """Return normal random numbers."""
        return torch.randn(*shape, generator=self.generator)

    def _drawn(self, frames: int, count: int) -> Float[Tensor, "N T 8 3"]:
        """Return the joints of random pieces of the recordings."""
        lengths = [len(sequence) for sequence in self.pool]
        pieces = draw_pieces(self.weight, lengths, frames, count, self.generator)
        return torch.stack([self.pool[i][rows] for i, rows in pieces])

    def _mirrored(self, joints: Float[Tensor, "N T 8 3"]) -> Float[Tensor, "N T 8 3"]:
        """Return the joints, every second time as a mirror has them."""
        flip = torch.rand(len(joints), generator=self.generator) < 0.5
        return torch.where(flip[:, None, None, None], mirror_pose(joints), joints)

    def _turns(self, count: int) -> Float[Tensor, "N 3 3"]:
        """Return rotations: about the vertical, then two tilts."""
        anyhow = (2 * torch.rand(count, generator=self.generator) - 1) * math.pi
        often = torch.rand(count, generator=self.generator) < _ANY
        turn = torch.where(often, anyhow, _TURN * self.normal(count))
        tilts = _TILT * self.normal(2, count)
        return euler_to_matrix(torch.stack([*tilts, turn], -1), "zxy")


class _Examples(ArmExamples):
    """Draws of features and bones: sequences of arms in random cameras."""

    def __call__(self, frames: int, count: int) -> tuple[Tensor, Tensor]:
        """Return features [count, frames, F] and bones [count, frames, 12] in units of `_TARGET`."""
        joints, bones = self.bodies(frames, count)
        place = self.place(count, _DEPTH, _DEPTH_STD, _NEAREST)
        ends = joints[:, :, _ARMS] + place[:, None, None, None]
        neck = ends[:, :, :, 0].mean(2) + 0.015 * self.normal(count, 1, 3)
        rays, middle = (x[..., :2] / x[..., 2:].clamp_min(0.2) for x in (ends, neck))
        rays, middle = (x + _NOISE * self.normal(*x.shape) for x in (rays, middle))
        all_given = torch.rand(count, 1, generator=self.generator) < 0.5
        given = all_given | torch.tensor(FEW)
        return _features(rays, middle, given), bones.flatten(2) / _TARGET


def _features(
    rays: Float[Tensor, "B T 2 3 2"], neck: Float[Tensor, "B T 2"], given: Bool[Tensor, "B 3"]
) -> Float[Tensor, "B T F"]:
    """Return rays relative to the neck in units of the largest extent so far, and that extent."""
    mask = given[:, None, None, :, None].to(rays)
    apart = (rays - neck[:, :, None, None]) * mask
    extent = apart.norm(dim=-1).flatten(2)
    so_far = torch.cummax(extent, 1).values
    largest = so_far.amax(-1, keepdim=True).clamp_min(1e-3)
    shown = given[:, None].expand(-1, rays.shape[1], -1).to(rays)
    return torch.cat([apart.flatten(2) / largest, so_far / largest, largest.log(), neck, shown], -1)
