"""Track arms of bones that keep their lengths, from any of the eight joints.

A point-mass filter: the depth of the body and the turn of its shoulders on a grid, and for each arm a
set of hypotheses on the rays of what is measured, tied from frame to frame. The lengths of bones are
learnt on the way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchpose._core.module_state import derived
from torchpose.errors import InputError
from torchpose.math._rotations import within_half_turn
from torchpose.priors._arms import ArmPrior, shipped_arm_prior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._torso import KINECT_NECK, upright_axes
from torchpose.upper_body._arm_chain import (
    ArmChain,
    ArmInput,
    Arms,
    ArmState,
    DirectionDensity,
)
from torchpose.upper_body._articulated_poses import (
    ELBOWS,
    HANDS,
    SHOULDERS,
    SIDES,
    FramePose,
    SeenBody,
    bones_of,
    estimates_of,
    pose_of,
)
from torchpose.upper_body._body_lengths import BodyLengths, KnownBody, Lengths
from torchpose.upper_body._estimator import (
    ArmGenerators,
    ArmJoints,
    Bones,
    Estimates,
    Estimator,
    TrackerModel,
    repeat_last,
)
from torchpose.upper_body._face import FacePoints, face_evidence, head_in_face
from torchpose.upper_body._lean import lean_angle, rolled, seen_lean
from torchpose.upper_body._measurements import MeasuredJoints
from torchpose.upper_body._pose_track import PoseTrack
from torchpose.upper_body._root_grid import (
    Root,
    RootGrid,
    Torso,
    half_widths,
    middle_of_shoulders,
    see_torso,
    shoulder_offsets,
    spine_places,
)

__all__ = ["ArticulatedFilter", "ArticulatedState"]

_NECK = UPPER_BODY.index("neck")
_SPINE = [_NECK, UPPER_BODY.index("head")]
_ROOTS = 10  # hypotheses of the root that arms are weighed for
_COARSE_ANGLES, _COARSE_AROUND = 11, 24  # of limbs, while roots are weighed
_SHARE = 0.2  # seconds over which frames say the same about the torso and about lengths
_MODE = math.radians(45.0)  # turns farther than that from the likeliest are another mode


class ArticulatedState(NamedTuple):
    """State of `ArticulatedFilter` between two frames.

    Attributes:
        root: belief over size, depth and turn of the torso, [B, S, Z, P]. lengths: of the bones.
        arms: belief over the arms; None before the first frame.
        middle: of the shoulders, camera axes, [B, 3]; on the axis before any of the torso was seen.
        lean: moments of the line between the shoulders (`seen_lean`), [B, 2].
        frame: number of frames before.
    """

    root: Tensor
    lengths: Lengths
    arms: ArmState | None
    middle: Tensor
    lean: Tensor
    frame: int


class _Frame(NamedTuple):
    """One frame as rays.

    Attributes:
        rays: [B, 8, 3]. known: [B, 8]. std: of their pixels over the focal length, [B, 8].
        exact: whether nobody doubts any of them, [B].
        face: rays of nose, eyes and ears, None if there are none.
    """

    rays: Tensor
    known: Tensor
    std: Tensor
    exact: Tensor
    face: FacePoints | None

    def level(self, lean: Float[Tensor, " B"]) -> _LevelFrame:
        """Return the frame as a camera sees it that leans as the torso does."""
        rays, face = rolled(self.rays, -lean), self.face
        if face is not None:
            face = face._replace(places=rolled(face.places, -lean))
        torso = see_torso(rays, self.known, self.std)
        return _LevelFrame(rays, self.known, self.std, self.exact, face, torso)


class _LevelFrame(NamedTuple):
    """One frame in which torsos are upright: as `_Frame`, and what the joints say about the torso."""

    rays: Tensor
    known: Tensor
    std: Tensor
    exact: Tensor
    face: FacePoints | None
    torso: Torso


class _Roots(NamedTuple):
    """Hypotheses of depth and turn in a frame.

    Attributes:
        belief: over the grid, [B, S, Z, P]. root: the likeliest of them.
        near: share of each in the estimate, [B, M]. arms: of each. middle: of the shoulders, [B, M, 3].
    """

    belief: Tensor
    root: Root
    near: Tensor
    arms: Arms
    middle: Tensor


class _Step(NamedTuple):
    """What a frame leaves: the next state, the body, and what is believed of its arms."""

    state: ArticulatedState
    body: SeenBody
    arms: ArmState


class ArticulatedFilter(Estimator):
    """Estimator of arms whose bones keep their lengths, from any of the eight joints.

    0. The lean of the torso to a side, by which the frame is turned about the optical axis (`seen_lean`).
    1. The torso: its depth, its size, which stays, and the turn of the shoulders on a grid, weighed by
       what torso joints, the face and both arms together say (`RootGrid`, `face_evidence`,
       `ArmChain.evidence_of_both`).
    2. The lengths of upper arm, forearm, shoulders and head, a Gaussian over their logs that starts as
       the prior over persons and sharpens (assumed-density filter). One camera does not tell a large
       body that is far from a small one that is near, so the common scale stays the prior's.
    3. The arms: hypotheses at every angle to the image that a bone of known length may have, weighed by
       a density over directions and tied to those of the frame before (`ArmChain`), and with `smoothing`
       to those of later frames, of which 40 kB each are kept.

    Args:
        model: of the tracker. arms: prior over arms, or its file; by default the one that comes with
            the package. bone_lengths: of the person, metres, where they were measured: any of
            upper_arm, forearm (to the measured hand or wrist), shoulder_width and head_height (above the
            neck). height: of the person, metres. person: poses of the same person, or the file that
            `PoseTrack.save` wrote: their last lengths. Lengths that are not known are expected in proportion.

    Raises:
        InputError: arms of another kind, no such file, a length or height that nobody has, or poses
            without lengths. FileFormatError: a file of another kind.
    """

    calibration = "articulated"
    smooths = True
    knows_wrists = True

    def __init__(
        self,
        model: TrackerModel,
        arms: ArmPrior | str | Path | None = None,
        bone_lengths: Mapping[str, float] | None = None,
        height: float | None = None,
        person: PoseTrack | str | Path | None = None,
    ) -> None:
        if not isinstance(arms, ArmPrior | str | Path | None):
            raise InputError(
                f"arms must be a prior over arms or the path of its file, got {type(arms).__name__}"
            )
        self.model = model
        owner = model.owner
        like = model.measurement_cov
        self.prior = arms if isinstance(arms, ArmPrior) else _kept(owner, arms, like)
        prior = self.prior
        sources = (*prior.directions.parameters_tuple(), prior.log_mass, prior.together)
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
        info, (self.neck_between, self.middle_alone) = model.prior.info, model.middle
        hand = model.hand or info.hand
        neck = "mid-shoulder" if self.middle_alone else info.neck
        known = KnownBody(bone_lengths, height, person)
        self.lengths = derived(
            owner,
            ("body lengths", hand, neck, known.key),
            (like, self.prior.lengths, self.prior.spread),
            lambda: BodyLengths(self.prior, hand, neck, known, like),
        )
        self.matrix = info.matrix.to(like)

    def init(
        self, batch_size: int, joints: ArmJoints, arm_generators: ArmGenerators
    ) -> ArticulatedState:
        """Return the state before the first frame; see `Estimator`."""
        root = self.grid.init(batch_size, self.lengths.size_spread)
        lengths = self.lengths.init(batch_size, self.grid.moments(root).of_size)
        middle = root.new_tensor([0.0, 0.0, 1.0]).expand(batch_size, -1)
        lean = root.new_zeros(batch_size, 2)
        return ArticulatedState(root, lengths, None, middle, lean, 0)

    def advance(
        self, state: ArticulatedState, measured: MeasuredJoints, progress: bool = False
    ) -> tuple[ArticulatedState, Estimates]:
        """Return the next state and the estimates of T more frames; see `Estimator`."""
        poses = []
        for step in self._steps(state, measured, progress):
            state = step.state
            poses.append(self._pose(step.body, step.arms))
        return state, estimates_of(poses, self.matrix, self.lengths.names)

    def forward(
        self,
        measured: MeasuredJoints,
        joints: ArmJoints,
        arm_generators: ArmGenerators,
        lengths: Tensor | None = None,
        progress: bool = False,
    ) -> Estimates:
        """Return the estimates of whole sequences; see `Estimator`."""
        smoothing = self.model.smoothing
        if smoothing is None:
            return super().forward(measured, joints, arm_generators, lengths, progress)
        state = self.init(len(measured.uv), joints, arm_generators)
        steps = list(self._steps(state, measured, progress))
        lag = int(smoothing) if isinstance(smoothing, int) else None
        smoothed = self.chain.smoothed([step.arms for step in steps], lengths, lag)
        poses = [self._pose(step.body, arms) for step, arms in zip(steps, smoothed, strict=True)]
        return repeat_last(estimates_of(poses, self.matrix, self.lengths.names), lengths)

    def _pose(self, body: SeenBody, belief: ArmState) -> FramePose:
        """Return the estimate of a frame."""
        return pose_of(body, belief, self.matrix, self.model.calibrated)

    def _steps(
        self, state: ArticulatedState, measured: MeasuredJoints, progress: bool = False
    ) -> Iterator[_Step]:
        """Yield what each frame leaves."""
        for frame in tqdm(self._frames(measured), disable=not progress, desc="frames"):
            step = self._step(state, frame)
            state = step.state
            yield step

    def _frames(self, measured: MeasuredJoints) -> list[_Frame]:
        """Return the frames one by one, as rays."""
        focal = (self.matrix[0, 0] * self.matrix[1, 1]).sqrt()
        if self.middle_alone:
            measured = _with_middle(measured)
        uv = measured.uv
        ones = torch.ones_like(uv[..., :1])
        rays = torch.cat([uv, ones], -1) @ torch.linalg.inv(self.matrix).mT
        variance = measured.cov.diagonal(dim1=-2, dim2=-1).mean(-1)
        std = (variance.sqrt() / focal).expand(uv.shape[:3])
        sure = measured.confidence
        exact = measured.mask.any(-1) if sure is None else (sure >= 1).all(-1)
        parts = zip(
            rays.unbind(1), measured.mask.unbind(1), std.unbind(1), exact.unbind(1), strict=True
        )
        faces = self._faces(measured)
        return [_Frame(*part, face) for part, face in zip(parts, faces, strict=True)]

    def _faces(self, measured: MeasuredJoints) -> Sequence[FacePoints | None]:
        """Return the face in each frame, as rays."""
        face = measured.face
        if face is None:
            return [None] * measured.uv.shape[1]
        focal, centre = self.matrix.diagonal()[:2], self.matrix[:2, 2]
        places = (face.places - centre) / focal
        parts = zip(places.unbind(1), face.confidence.unbind(1), strict=True)
        return [FacePoints(*part, face.expected) for part in parts]

    def _step(self, state: ArticulatedState, frame: _Frame) -> _Step:
        """Return what a frame leaves, worked out in a camera that leans as the torso does."""
        depth = self.grid.moments(state.root).depth
        lean = seen_lean(state.lean, frame.rays, frame.known, depth, self.model.rate)
        angle = lean_angle(lean)
        level = state._replace(middle=rolled(state.middle, -angle), lean=lean)
        new, body, belief = self._level_step(level, frame.level(angle))
        new = new._replace(middle=rolled(new.middle, angle))
        return _Step(new, body._replace(lean=angle), belief)

    def _level_step(self, state: ArticulatedState, frame: _LevelFrame) -> _Step:
        """Return what a frame leaves in which torsos are upright."""
        lengths, slack = self.lengths.metres(state.lengths), self.lengths.slack(state.lengths)
        roots = self._weigh(state, frame, lengths, slack)
        root = self._mean(roots.root, roots.near)
        middle = self._middle(state, frame.torso, root)
        arms = self._arms(frame, root, middle, lengths, slack)
        belief = (
            self.chain.start(arms) if state.arms is None else self.chain.advance(state.arms, arms)
        )
        learnt = state.lengths
        if state.frame % self.stride == 0:
            of_lengths = partial(self._evidence_of, frame, root, middle)
            learnt = self.lengths.learn(learnt, frame.torso, root, of_lengths)
        others = self._covs_of_root(frame, roots, lengths)
        before = self.grid.moments(state.root)
        bones = self.lengths.shown(state.lengths, before.size, before.of_size)
        body = self._body(frame, root, middle, state.lengths, bones)
        far = self.grid.moments(roots.belief).of_depth
        body = body._replace(others=others, far=far)
        new = ArticulatedState(
            roots.belief, learnt, belief, middle[:, 0], state.lean, state.frame + 1
        )
        return _Step(new, body, belief)

    def _weigh(
        self, state: ArticulatedState, frame: _LevelFrame, lengths: Tensor, slack: Tensor
    ) -> _Roots:
        """Return depths and turns, weighed by the torso, the face and the arms."""
        power = 1.0 if state.arms is None else 1 / self.stride
        size = self.lengths.torso(state.lengths)
        believed = self.grid.predict(state.root).log()
        believed = believed + power * self.grid.evidence(frame.torso, size)
        if frame.face is not None:
            std = frame.std.amin(1)
            said = face_evidence(frame.face, std, self.grid.depth, self.grid.turn)
            believed = believed + said[:, None]
        root = self.grid.best(believed, _ROOTS)
        middle = self._middle(state, frame.torso, root)
        arms = self._arms(frame, root, middle, lengths, slack, _COARSE_ANGLES, _COARSE_AROUND)
        seen = frame.known[:, [ELBOWS, HANDS]].sum((1, 2)).to(root.depth)
        evidence = power * (
            self.chain.evidence_of_both(arms) + 2 * seen[:, None] * root.depth.log()
        )
        belief = self.grid.belief(believed, root, evidence, _told_by_hands(frame))
        root = root._replace(log_weight=root.log_weight + evidence)
        return _Roots(belief, root, self._near(root), arms, middle)

    def _middle(self, state: ArticulatedState, torso: Torso, root: Root) -> Float[Tensor, "B M 3"]:
        """Return the middle of the shoulders, where it was last if nothing of the torso is measured."""
        size = self.lengths.torso(state.lengths)
        found = middle_of_shoulders(torso, root, size)
        before = (state.middle / state.middle[:, 2:])[:, None] * root.depth[..., None]
        return torch.where(torso.known.any(1)[:, None, None], found, before)

    def _shoulders(
        self, frame: _LevelFrame, root: Root, middle: Tensor, width: Tensor
    ) -> Float[Tensor, "B 2 M 3"]:
        """Return both shoulders: on their rays where they are measured."""
        half = half_widths(width, frame.torso.raised(root.depth)) * root.size[..., None]
        offsets = shoulder_offsets(root.turn, half)
        inferred = (middle[..., None, :] + offsets).transpose(1, 2)
        ray = frame.rays[:, SHOULDERS, None]
        on_ray = ray / ray[..., 2:] * inferred[..., 2:]
        return torch.where(frame.known[:, SHOULDERS, None, None], on_ray, inferred)

    def _arms(
        self,
        frame: _LevelFrame,
        root: Root,
        middle: Tensor,
        lengths: Tensor,
        slack: Tensor,
        angles: int | None = None,
        around: int | None = None,
    ) -> Arms:
        """Return the hypotheses about both arms for each hypothesis of the root."""
        flip = root.depth.new_tensor(SIDES)
        shoulder = self._shoulders(frame, root, middle, lengths[:, 2]) * flip[:, None]
        rays = torch.stack([frame.rays[:, ELBOWS], frame.rays[:, HANDS]], 2) * flip[:, None]
        noise = frame.std[:, [SHOULDERS, ELBOWS, HANDS]].square()
        noise = torch.where(frame.known[:, [SHOULDERS, ELBOWS, HANDS]], noise, 0.0)
        std = torch.stack([noise[:, 0] + noise[:, 1], noise[:, 1] + noise[:, 2]], -1).sqrt()
        known = torch.stack([frame.known[:, ELBOWS], frame.known[:, HANDS]], -1)
        axes = upright_axes(root.turn)
        axes = torch.stack([axes, flip[1, :, None] * axes * flip[1]], 1)
        bones = lengths[:, None, None, :2].expand(*shoulder.shape[:3], 2)
        arm = ArmInput(shoulder, rays, known, std, axes, bones, slack)
        sizes = {} if angles is None or around is None else {"angles": angles, "around": around}
        return self.chain.hypotheses(arm, **sizes)

    @staticmethod
    def _near(root: Root) -> Float[Tensor, "B M"]:
        """Return the shares of the hypotheses, of those alone that are turned about as the likeliest."""
        weight = torch.softmax(root.log_weight, 1)
        best = root.turn.gather(1, weight.argmax(1, keepdim=True))
        off = within_half_turn(root.turn - best)
        near = weight * (-0.5 * (off / _MODE).square()).exp()
        return near / near.sum(1, keepdim=True)

    @staticmethod
    def _mean(root: Root, near: Float[Tensor, "B M"]) -> Root:
        """Return the mean of hypotheses with these shares, as the only one."""
        best = root.turn.gather(1, near.argmax(1, keepdim=True))
        off = within_half_turn(root.turn - best)
        depth = (near * root.depth.log()).sum(1, keepdim=True).exp()
        size = (near * root.size.log()).sum(1, keepdim=True).exp()
        turn = best + (near * off).sum(1, keepdim=True)
        return Root(depth, turn, size, torch.zeros_like(depth), torch.zeros_like(root.cell[:, :1]))

    def _covs_of_root(
        self, frame: _LevelFrame, roots: _Roots, lengths: Tensor
    ) -> Float[Tensor, "B 4 3 3"]:
        """Return how far both elbows, then both hands, are off where other hypotheses of the root hold."""
        _, root, near, arms, middle = roots
        shoulder = self._shoulders(frame, root, middle, lengths[:, 2]) - middle[:, None]
        bones = bones_of(arms.mean_directions, upright_axes(root.turn)[:, None], lengths)
        ends = shoulder[..., None, :] + bones.cumsum(-2)
        used = (near[:, None, :, None, None] * ends).sum(2, keepdim=True)
        off = (ends - used).permute(0, 3, 1, 2, 4).flatten(1, 2)
        weight = torch.softmax(root.log_weight, 1)[:, None, :, None]
        return (weight * off).mT @ off

    def _evidence_of(
        self, frame: _LevelFrame, root: Root, middle: Tensor, lengths: Float[Tensor, "B 4"]
    ) -> Float[Tensor, " B"]:
        """Return the log-evidence of both arms under bones of these lengths, metres."""
        stiff = torch.zeros_like(lengths[:, :2])
        arms = self._arms(frame, root, middle, lengths, stiff, _COARSE_ANGLES, _COARSE_AROUND)
        return arms.log_evidence.sum((1, 2))

    def _body(
        self, frame: _LevelFrame, root: Root, middle: Tensor, lengths: Lengths, bones: Bones
    ) -> SeenBody:
        """Return the body but for the arms, of one hypothesis of the root that is right."""
        metres = self.lengths.metres(lengths)
        shoulders = self._shoulders(frame, root, middle, metres[:, 2])[:, :, 0]
        joints = middle.new_zeros(len(middle), 8, 3)
        joints[:, SHOULDERS] = shoulders
        joints[:, _SPINE] = self._spine(frame, root, middle, shoulders, lengths)
        scale = self.lengths.scale.expand(len(middle))
        turn = root.turn[:, 0]
        level, sure = torch.zeros_like(turn), middle.new_zeros(len(middle), 4, 3, 3)
        return SeenBody(
            joints, frame.known, frame.exact, metres, bones, scale, sure, level, turn, level
        )

    def _spine(
        self, frame: _LevelFrame, root: Root, middle: Tensor, shoulders: Tensor, lengths: Lengths
    ) -> Float[Tensor, "B 2 3"]:
        """Return neck and head: on their rays where they are measured, the head by its face too."""
        upright = middle + spine_places(self.lengths.torso(lengths)) * root.size[..., None]
        ray = frame.rays[:, _SPINE]
        on_ray = ray / ray[..., 2:] * upright[..., 2:]
        known = frame.known[:, _SPINE, None]
        neck, head = torch.where(known, on_ray, upright).unbind(1)
        if frame.face is not None:
            std, depth, turn = frame.std.amin(1), upright[:, 1, 2], root.turn[:, 0]
            found, told = head_in_face(frame.face, std, depth, turn, self.grid.turn)
            head = torch.where(told[:, None] & ~known[:, 1], found, head)
        if self.neck_between:
            neck = shoulders.mean(1).lerp(head, KINECT_NECK.fraction)
        return torch.stack([neck, head], 1)


def _told_by_hands(frame: _LevelFrame) -> Bool[Tensor, " B"]:
    """Return whether hands say what lies beyond the hypotheses: elbows are sharper than a trend.

    A torso of one joint has no size in the image, and arms alone are a poor witness of how far it is.
    """
    return (frame.torso.known.sum(1) > 1) & ~frame.known[:, ELBOWS].any(1)


def _with_middle(measured: MeasuredJoints) -> MeasuredJoints:
    """Return the joints with the middle of the shoulders for a neck, as it was measured."""
    middle = measured.middle
    if middle is None:
        return measured
    uv, mask, cov = (x.clone() for x in measured[:3])
    uv[..., _NECK, :], mask[..., _NECK] = middle.uv, middle.mask & mask[..., _NECK]
    cov[..., _NECK, :, :] = middle.cov
    return measured._replace(uv=uv, mask=mask, cov=cov)


def _kept(owner: nn.Module, path: str | Path | None, like: Tensor) -> ArmPrior:
    """Return the prior of a file, or that of the package; read once for each tracker."""
    return derived(
        owner,
        ("arm prior", str(path)),
        (like,),
        lambda: ArmPrior.load(path) if path else shipped_arm_prior(),
    )
