"""Track arms of bones that keep their lengths, from any of the eight joints.

A point-mass filter: the depth of the body and the turn of its shoulders on a grid, and for each arm a
set of hypotheses on the rays of what is measured, tied from frame to frame. The lengths of bones are
learnt on the way.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchpose._core.module_state import derived
from torchpose.errors import InputError
from torchpose.filters._base import Generators
from torchpose.priors._arms import LENGTHS, ArmPrior, shipped_arm_prior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._torso import upright_axes
from torchpose.upper_body._arm_chain import (
    ArmChain,
    ArmInput,
    Arms,
    ArmState,
    DirectionDensity,
)
from torchpose.upper_body._articulated_poses import FramePose, estimates_of
from torchpose.upper_body._estimator import ArmJoints, Estimates, Estimator, TrackerModel
from torchpose.upper_body._measurements import MeasuredJoints
from torchpose.upper_body._root_grid import (
    SHRUG,
    Root,
    RootGrid,
    Torso,
    TorsoLengths,
    middle_of_shoulders,
    see_torso,
    shoulder_offsets,
    torso_places,
)

__all__ = ["ArticulatedFilter", "ArticulatedState"]

_JOINT = {name: i for i, name in enumerate(UPPER_BODY)}
_SHOULDERS, _ELBOWS, _HANDS = (
    [_JOINT[f"{joint}_{side}"] for side in ("left", "right")]
    for joint in ("shoulder", "elbow", "hand")
)
_ROOTS = 10  # hypotheses of the root that arms are weighed for
_COARSE_ANGLES, _COARSE_AROUND = 11, 24  # of limbs, while roots are weighed
_POWER = 0.3  # of the evidence of arms about the root: those of near frames are alike
_NUDGE = 0.03  # of a log-length, to see what a frame says about it
_MOST = 0.1  # of a log-length that one frame may change it by
_SHARE = 0.2  # seconds over which frames say the same about a length
_WIDTH_STD, _HEIGHT_STD = 0.05, 0.05  # metres: shoulders and heads move in their torsos
_MODE = math.radians(45.0)  # turns farther than that from the likeliest are another mode
_SIDES = ((1.0, 1.0, 1.0), (-1.0, 1.0, 1.0))  # right arms are mirrored
_TORSO_STD = 0.03  # metres: of torso joints in space


class Lengths(NamedTuple):
    """Gaussian over the logs of the lengths of a person, relative to the prior's.

    Attributes:
        mean: of upper arm, forearm, width between the shoulders and height of the head, [B, 4].
        precision: [B, 4].
    """

    mean: Tensor
    precision: Tensor


class ArticulatedState(NamedTuple):
    """State of `ArticulatedFilter` between two frames.

    Attributes:
        root: belief over depth and turn, [B, Z, P]. lengths: of the bones.
        arms: belief over the arms; None before the first frame.
        middle: of the shoulders, camera axes, [B, 3], NaN before anything of the torso was seen.
        frame: number of frames before.
    """

    root: Tensor
    lengths: Lengths
    arms: ArmState | None
    middle: Tensor
    frame: int


class _Frame(NamedTuple):
    """One frame as rays: [B, 8, 3], which are known [B, 8], and their noise over the focal length [B, 8]."""

    rays: Tensor
    known: Tensor
    std: Tensor


class ArticulatedFilter(Estimator):
    """Estimator of arms whose bones keep their lengths, from any of the eight joints.

    1. The torso: depth and turn of the shoulders on a grid, weighed by what torso joints and arms say
       (`RootGrid`).
    2. The lengths of upper arm, forearm, shoulders and head, a Gaussian over their logs that starts as
       the prior over persons and sharpens (assumed-density filter). One camera does not tell a large
       body that is far from a small one that is near, so the common scale stays the prior's.
    3. The arms: hypotheses at every angle to the image that a bone of known length may have, weighed by
       a density over directions and tied to those of the frame before (`ArmChain`).

    Args:
        model: of the tracker. arms: prior over arms, or its file; by default the one that comes with
            the package.

    Raises:
        InputError: arms of another kind, or no such file. FileFormatError: a file of another kind.
    """

    calibration = "articulated"

    def __init__(self, model: TrackerModel, arms: ArmPrior | str | Path | None = None) -> None:
        if not isinstance(arms, ArmPrior | str | Path | None):
            raise InputError(
                f"arms must be a prior over arms or the path of its file, got {type(arms).__name__}"
            )
        self.model = model
        owner = model.owner
        like = model.measurement_cov
        self.prior = arms if isinstance(arms, ArmPrior) else _kept(owner, arms, like)
        sources = (*self.prior.directions.parameters_tuple(), self.prior.log_mass)
        density = derived(
            owner,
            ("arm density", self.prior.broad, like.device),
            sources,
            lambda: DirectionDensity(self.prior, like.device),
        )
        self.stride = max(1, round(_SHARE * model.rate))
        self.chain = ArmChain(density, model.rate)
        self.grid = derived(
            owner, ("root grid", model.rate), (like,), lambda: RootGrid(model.rate, like)
        )
        hand = "forearm" if (model.hand or model.prior.info.hand) == "wrist" else "forearm_to_hand"
        rows = [LENGTHS.index(n) for n in ("upper_arm", hand, "shoulder_width", "head_height")]
        self.usual = self.prior.lengths[rows].to(like)
        self.spread = self.prior.spread[rows].to(like)
        self.matrix = model.prior.info.matrix.to(like)

    def init(
        self, batch_size: int, joints: ArmJoints, generators: dict[str, Generators]
    ) -> ArticulatedState:
        """Return the state before the first frame; see `Estimator`."""
        precision = self.spread.square().reciprocal().expand(batch_size, -1)
        lengths = Lengths(torch.zeros_like(precision), precision)
        middle = precision.new_full((batch_size, 3), math.nan)
        return ArticulatedState(self.grid.init(batch_size), lengths, None, middle, 0)

    def advance(
        self, state: ArticulatedState, measured: MeasuredJoints
    ) -> tuple[ArticulatedState, Estimates]:
        """Return the next state and the estimates of T more frames; see `Estimator`."""
        state, poses = self._run(state, measured)
        return state, estimates_of(poses, self.matrix)

    def forward(
        self,
        measured: MeasuredJoints,
        joints: ArmJoints,
        generators: dict[str, Generators],
        lengths: Tensor | None = None,
        progress: bool = False,
    ) -> Estimates:
        """Return the estimates of whole sequences; see `Estimator`."""
        state = self.init(len(measured.uv), joints, generators)
        _, poses = self._run(state, measured, progress)
        return estimates_of(poses, self.matrix, lengths)

    def _run(
        self, state: ArticulatedState, measured: MeasuredJoints, progress: bool = False
    ) -> tuple[ArticulatedState, list[FramePose]]:
        """Return the next state, and the estimate of each frame."""
        poses = []
        for frame in tqdm(self._frames(measured), disable=not progress, desc="frames"):
            state, pose = self._step(state, frame)
            poses.append(pose)
        return state, poses

    def _frames(self, measured: MeasuredJoints) -> list[_Frame]:
        """Return the frames one by one, as rays."""
        focal = (self.matrix[0, 0] * self.matrix[1, 1]).sqrt()
        uv = measured.uv
        ones = torch.ones_like(uv[..., :1])
        rays = torch.cat([uv, ones], -1) @ torch.linalg.inv(self.matrix).mT
        variance = measured.cov.diagonal(dim1=-2, dim2=-1).mean(-1)
        std = (variance.sqrt() / focal).expand(uv.shape[:3])
        parts = zip(rays.unbind(1), measured.mask.unbind(1), std.unbind(1), strict=True)
        return [_Frame(*part) for part in parts]

    def _step(self, state: ArticulatedState, frame: _Frame) -> tuple[ArticulatedState, FramePose]:
        """Return the next state and the estimate of one frame."""
        lengths = self._lengths(state.lengths)
        slack = lengths[:, :2] * state.lengths.precision[:, :2].rsqrt()
        slack[:, 0] = 0.0  # the common scale moves the body, not the pixels
        torso = see_torso(frame.rays, frame.known, frame.std)
        size = self._torso_lengths(state.lengths)
        predicted = self.grid.predict(state.root)
        believed = predicted.log() + self.grid.evidence(torso, size)
        root = self.grid.best(believed, _ROOTS)
        middle = self._middle(state, torso, root, size)
        weighed = self._arms(frame, root, middle, lengths, slack, _COARSE_ANGLES, _COARSE_AROUND)
        seen = frame.known[:, [_ELBOWS, _HANDS]].sum((1, 2)).to(root.depth)
        evidence = weighed.log_evidence.sum(1) + 2 * seen[:, None] * root.depth.log()
        root = root._replace(log_weight=root.log_weight + _POWER * evidence)
        likely = self._likely(root)
        centre = self._middle(state, torso, likely, size)
        arms = self._arms(frame, likely, centre, lengths, slack)
        belief = (
            self.chain.start(arms) if state.arms is None else self.chain.advance(state.arms, arms)
        )
        learnt = state.lengths
        if state.frame % self.stride == 0:
            learnt = self._learn(learnt, frame, torso, likely, centre)
        pose = self._pose(belief, frame, likely, centre, lengths, size)
        new = ArticulatedState(
            self.grid.belief(root), learnt, belief, centre[:, 0], state.frame + 1
        )
        return new, pose

    def _lengths(self, lengths: Lengths) -> Float[Tensor, "B 4"]:
        return self.usual * lengths.mean.exp()

    def _torso_lengths(self, lengths: Lengths) -> TorsoLengths:
        metres = self._lengths(lengths)[:, 2:]
        std = metres * lengths.precision[:, 2:].rsqrt()
        return TorsoLengths(*metres.unbind(1), *std.unbind(1))

    def _middle(
        self, state: ArticulatedState, torso: Torso, root: Root, size: TorsoLengths
    ) -> Float[Tensor, "B M 3"]:
        """Return the middle of the shoulders, where it was last if nothing of the torso is measured."""
        found = middle_of_shoulders(torso, root.depth, root.turn, size)
        start = found.new_tensor([0.0, 0.0, 1.0])
        ray = torch.where(state.middle.isnan().any(-1, True), start, state.middle)
        before = ray[:, None] / ray[:, None, 2:] * root.depth[..., None]
        return torch.where(torso.known.any(1)[:, None, None], found, before)

    def _shoulders(
        self, frame: _Frame, root: Root, middle: Tensor, width: Tensor
    ) -> Float[Tensor, "B 2 M 3"]:
        """Return both shoulders: on their rays where they are measured."""
        half = shoulder_offsets(root.turn, width[:, None].expand_as(root.turn))
        inferred = torch.stack([middle + half, middle - half], 1)
        ray = frame.rays[:, _SHOULDERS, None]
        on_ray = ray / ray[..., 2:] * inferred[..., 2:]
        return torch.where(frame.known[:, _SHOULDERS, None, None], on_ray, inferred)

    def _arms(
        self,
        frame: _Frame,
        root: Root,
        middle: Tensor,
        lengths: Tensor,
        slack: Tensor,
        angles: int | None = None,
        around: int | None = None,
    ) -> Arms:
        """Return the hypotheses about both arms for each hypothesis of the root."""
        flip = root.depth.new_tensor(_SIDES)
        shoulder = self._shoulders(frame, root, middle, lengths[:, 2]) * flip[:, None]
        rays = torch.stack([frame.rays[:, _ELBOWS], frame.rays[:, _HANDS]], 2) * flip[:, None]
        noise = frame.std[:, [_SHOULDERS, _ELBOWS, _HANDS]].square()
        noise = torch.where(frame.known[:, [_SHOULDERS, _ELBOWS, _HANDS]], noise, 0.0)
        std = torch.stack([noise[:, 0] + noise[:, 1], noise[:, 1] + noise[:, 2]], -1).sqrt()
        known = torch.stack([frame.known[:, _ELBOWS], frame.known[:, _HANDS]], -1)
        axes = upright_axes(root.turn)
        axes = torch.stack([axes, flip[1, :, None] * axes * flip[1]], 1)
        bones = lengths[:, None, None, :2].expand(*shoulder.shape[:3], 2)
        arm = ArmInput(shoulder, rays, known, std, axes, bones, slack)
        sizes = {} if angles is None or around is None else {"angles": angles, "around": around}
        return self.chain.hypotheses(arm, **sizes)

    def _likely(self, root: Root) -> Root:
        """Return the mean of the hypotheses near the likeliest turn, as the only one."""
        weight = torch.softmax(root.log_weight, 1)
        best = root.turn.gather(1, weight.argmax(1, keepdim=True))
        off = torch.remainder(root.turn - best + math.pi, 2 * math.pi) - math.pi
        near = weight * (-0.5 * (off / _MODE).square()).exp()
        near = near / near.sum(1, keepdim=True)
        depth = (near * root.depth.log()).sum(1, keepdim=True).exp()
        turn = best + (near * off).sum(1, keepdim=True)
        return Root(depth, turn, torch.zeros_like(depth), torch.zeros_like(root.cell[:, :1]))

    def _learn(
        self, lengths: Lengths, frame: _Frame, torso: Torso, root: Root, middle: Tensor
    ) -> Lengths:
        """Return the lengths after a frame, one of a fifth of a second: the others say the same."""
        slope, bend = self._slopes(lengths, frame, root, middle)
        width, height = self._torso_slopes(lengths, torso, root)
        slope = torch.cat([slope, width[0], height[0]], 1)
        bend = torch.cat([bend, width[1], height[1]], 1).clamp_min(0.0)
        precision = lengths.precision + bend
        mean = lengths.mean + (slope / precision).clamp(-_MOST, _MOST)
        mean = mean - mean[:, :1]  # the common scale is not to be seen: upper arms stay the prior's
        limit = 3 * self.spread
        return Lengths(mean.clamp(-limit, limit), precision)

    def _slopes(
        self, lengths: Lengths, frame: _Frame, root: Root, middle: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return slope and bend of the evidence over the log-lengths of upper arm and forearm, [B, 2]."""
        nudges = lengths.mean.new_tensor(
            [[0, 0, 0, 0], [1, 0, 0, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, -1, 0, 0]]
        )
        values, stiff = [], torch.zeros_like(lengths.mean[:, :2])
        for nudge in nudges * _NUDGE:
            nudged = self._lengths(lengths._replace(mean=lengths.mean + nudge))
            arms = self._arms(frame, root, middle, nudged, stiff, _COARSE_ANGLES, _COARSE_AROUND)
            values.append(arms.log_evidence.sum((1, 2)))
        at, *pairs = values
        slope = [(pairs[i] - pairs[i + 1]) / (2 * _NUDGE) for i in (0, 2)]
        bend = [(2 * at - pairs[i] - pairs[i + 1]) / _NUDGE**2 for i in (0, 2)]
        return torch.stack(slope, 1), torch.stack(bend, 1)

    def _torso_slopes(
        self, lengths: Lengths, torso: Torso, root: Root
    ) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Return slope and bend of the evidence over the log-width and the log-height, [B, 1] each."""
        size = self._lengths(lengths)
        pairs = (
            (0, 1, 0, size[:, 2:3] * root.turn.cos(), _WIDTH_STD),
            (2, 3, 1, size[:, 3:], _HEIGHT_STD),
        )
        found = []
        for a, b, axis, expected, std in pairs:
            free = std**2 + (axis == 0) * (torso.raised * SHRUG).square().sum(1, keepdim=True)
            seen = (torso.rays[:, a, axis] - torso.rays[:, b, axis])[:, None] * root.depth
            both = (torso.known[:, a] & torso.known[:, b])[:, None].to(seen)
            slope = both * expected * (seen - expected) / free
            found.append((slope, both * expected.square() / free))
        return found[0], found[1]

    def _pose(
        self,
        belief: ArmState,
        frame: _Frame,
        root: Root,
        middle: Tensor,
        lengths: Tensor,
        size: TorsoLengths,
    ) -> FramePose:
        """Return joints and covariances in camera axes."""
        flip = root.depth.new_tensor(_SIDES)
        axes = upright_axes(root.turn[:, 0])
        shoulder = self._shoulders(frame, root, middle, lengths[:, 2])[:, :, 0]
        bones = self.chain.mean_directions(belief) * flip[:, None]
        bones = bones @ axes[:, None] * lengths[:, None, :2, None]
        elbow = shoulder + bones[:, :, 0]
        hand = elbow + bones[:, :, 1]
        torso = middle + torso_places(root.turn, size)[:, 0, 2:]
        joints = middle.new_zeros(len(middle), 8, 3)
        for rows, value in ((_SHOULDERS, shoulder), (_ELBOWS, elbow), (_HANDS, hand)):
            joints[:, rows] = value
        for i, name in enumerate(("neck", "head")):
            row = _JOINT[name]
            ray = frame.rays[:, row] / frame.rays[:, row, 2:] * torso[:, i, 2:]
            joints[:, row] = torch.where(frame.known[:, row, None], ray, torso[:, i])
        covs = self._covs(belief, joints, axes, lengths, flip)
        weight = belief.weight.clamp_min(1e-30).log()
        seen = frame.known[:, [_ELBOWS, _HANDS]].any(1)
        count = frame.known[:, [_ELBOWS, _HANDS]].sum(1).to(root.depth)
        area = 2 * root.depth.log() - (self.matrix[0, 0] * self.matrix[1, 1]).log()
        evidence = torch.where(seen, belief.log_evidence + count * area, 0.0)
        return FramePose(joints, covs, root.turn[:, 0], evidence, weight)

    def _covs(
        self, belief: ArmState, joints: Tensor, axes: Tensor, lengths: Tensor, flip: Tensor
    ) -> Float[Tensor, "B 8 3 3"]:
        """Return covariances: of the hypotheses about the estimate, of stiff torsos, and of the scale."""
        covs = torch.eye(3).to(joints).mul(_TORSO_STD**2).expand(*joints.shape, 3).clone()
        bones = belief.directions.unflatten(-1, (2, 3)) * flip[:, None, None]
        ends = (bones @ axes[:, None, None] * lengths[:, None, None, :2, None]).cumsum(-2)
        for limb, rows in ((0, _ELBOWS), (1, _HANDS)):
            off = ends[..., limb, :] - (joints[:, rows] - joints[:, _SHOULDERS])[:, :, None]
            covs[:, rows] += (belief.weight[..., None] * off).mT @ off
        apart = joints - joints[:, _JOINT["neck"], None]
        return covs + self.spread[0] ** 2 * apart[..., :, None] * apart[..., None, :]


def _kept(owner: nn.Module, path: str | Path | None, like: Tensor) -> ArmPrior:
    """Return the prior of a file, or that of the package; read once for each tracker."""
    return derived(
        owner,
        ("arm prior", str(path)),
        (like,),
        lambda: ArmPrior.load(path) if path else shipped_arm_prior(),
    )
