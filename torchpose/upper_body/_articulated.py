"""Track arms of bones that keep their lengths, from any of the eight joints.

A point-mass filter: the depth of the body and the turn of its shoulders on a grid (`RootStep`), and for
each arm a set of hypotheses on the rays of what is measured, tied from frame to frame (`ArmChain`). The
lengths of bones are learnt on the way (`BodyLengths`).
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from tqdm.auto import tqdm

from torchpose._core.module_state import derived, outside_inference
from torchpose._core.rows import where_rows
from torchpose.errors import InputError
from torchpose.priors._arms import ArmPrior, shipped_arm_prior
from torchpose.priors._lifting_network import LiftingNetwork, shipped_lifting_network
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._arm_chain import ArmChain, ArmState
from torchpose.upper_body._articulated_frame import (
    Facts,
    Optics,
    RayFrame,
    UprightFrame,
    apart,
    as_rays,
    facts_of,
    split,
    together,
    upright,
    with_middle,
)
from torchpose.upper_body._articulated_poses import (
    FramePose,
    SeenBody,
    enlarged,
    estimates_of,
    pose_of,
)
from torchpose.upper_body._articulated_root import Roots, RootStep, covs_of_roots
from torchpose.upper_body._articulated_torso import shoulder_places, torso_joints
from torchpose.upper_body._body_lengths import BodyLengths, KnownBody, Lengths, Sizes
from torchpose.upper_body._direction_density import DirectionDensity
from torchpose.upper_body._estimator import (
    ArmGenerators,
    ArmJoints,
    Bones,
    Estimates,
    Estimator,
    TrackerModel,
    repeat_last,
)
from torchpose.upper_body._held_keypoints import Held, LastSeen, hold_hidden
from torchpose.upper_body._lean import lean_angle, roll, seen_lean
from torchpose.upper_body._lifted_arms import LiftedBones, lift
from torchpose.upper_body._measured_joints import MeasuredJoints
from torchpose.upper_body._nearby_frames import averaged_over_frames, frames_of_reach
from torchpose.upper_body._pose_track import PoseTrack
from torchpose.upper_body._root_grid import Moments, RootGrid
from torchpose.upper_body._seen_size import SeenSize, follow_size
from torchpose.upper_body._torso_likelihood import Root

_SHARE = 0.2  # seconds over which frames say the same about lengths
_SHARE_OF_TORSO = 0.6  # the same about the torso
_UPDATE = 0.1  # seconds from one update of the torso to the next
_BEGINNING = 0.5  # seconds after the first frame in which a body may start again
_AT_ONCE = 32  # frames whose poses are read together
_BODIES_AT_ONCE = 4  # frames times sequences whose arms are weighed together: more gain nothing


class _Told(NamedTuple):
    """What the poses of a frame hold of torso and lengths, which most frames share with the one before.

    Attributes:
        bones: the lengths of bones as they are reported, given the belief `lengths` and the moments `before`.
        others: the covariances of limbs over the hypotheses `roots`, given `sizes`.
    """

    lengths: Lengths
    before: Moments
    bones: Bones
    roots: Roots
    sizes: Sizes
    others: Tensor


class ArticulatedState(NamedTuple):
    """State of `ArticulatedFilter` between two frames.

    Attributes:
        root: the belief over size, depth and turn of the torso at its last update, [B, S, Z, P].
        roots: the hypotheses about these of that update; None before the first frame.
        seen_size: how large the torso was seen at the updates so far.
        moments: the moments of the belief over these. lengths: the belief over the lengths of the bones.
        sizes: the lengths themselves. arms: the belief over the arms; None before the first frame.
        middle: the middle of the shoulders, camera axes, [B, 3]; on the optical axis before any of the
            torso was seen.
        lean: the moments of the line between the shoulders (`seen_lean`), [B, 2]. tilt: the roll of the
            axes in which it is level, [B, 3, 3].
        frame: the number of frames before.
        starts: the number of updates at which a body may still start, [B], one more before two joints of its
            torso are seen; None if 0 for everybody. It starts where an elbow or hand is seen beside these,
            since one joint has no size in the image, and so no depth that arms could rule out; and starts
            again until the frame fits a body.
        told: what the pose of the last frame holds of torso and lengths; None before the first, and after
            several frames at a time.
        memory: what the network remembers that lifts bones, [B, L, W]; None before the first frame, and
            where shoulders and elbows are not among the keypoints.
        last: where elbows and hands were last seen; None before the first frame.
    """

    root: Tensor
    roots: Roots | None
    seen_size: SeenSize
    moments: Moments
    lengths: Lengths
    sizes: Sizes
    arms: ArmState | None
    middle: Tensor
    lean: Tensor
    tilt: Tensor
    frame: int
    starts: Tensor | None
    told: _Told | None = None
    memory: Tensor | None = None
    last: LastSeen | None = None


class _Seen(NamedTuple):
    """What poses are read from: of one frame, or of T frames of B sequences [B T, ...].

    Attributes:
        frame, facts: the measurements, and what holds for them. tilt: the roll of the tilted axes, [B, 3, 3].
        sizes: the lengths of the bones. lengths: the belief that they are of.
        before, after: the moments of the torso before and after the frame.
        roots: the hypotheses about the root. root: their mean. middle: the middle of the shoulders given
            that, [B, 1, 3]. shoulders: their places, [B, 2, 1, 3].
    """

    frame: RayFrame
    facts: Facts
    tilt: Tensor
    sizes: Sizes
    lengths: Lengths
    before: Moments
    after: Moments
    roots: Roots
    root: Root
    middle: Tensor
    shoulders: Tensor


class _Step(NamedTuple):
    """Result of a frame: the next state, what its pose is read from, and the posterior of the arms."""

    state: ArticulatedState
    seen: _Seen
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
       to those of later frames, of which 40 kB each are kept. They lie on the rays of their frame, so with
       `smoothing` keypoints are averaged over nearby frames first (`averaged_over_frames`).

    Args:
        model: the model of the tracker.
        arms: the prior over arms, or its file; by default the one that comes with the package.
        bone_lengths: the lengths that were measured on the person, metres: any of upper_arm, forearm (to
            the measured hand or wrist), shoulder_width and head_height (above Kinect's neck, which is
            10.5 cm above the middle of the shoulders, whatever neck is measured). The others are expected
            in proportion.
        height: the height of the person, metres.
        person: poses of the same person, or the file that `PoseTrack.save` wrote, of which the last
            lengths are taken.

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
        owner, like = model.owner, model.measurement_cov
        prior = arms if isinstance(arms, ArmPrior) else _prior_of(owner, arms, like)
        density = derived(
            owner,
            ("arm density", prior.broad, like.device),
            (*prior.directions.parameters_tuple(), prior.log_mass, prior.together),
            lambda: DirectionDensity(prior, like.device),
        )
        self.ahead = frames_of_reach(model.rate, model.smoothing)
        self.stride = max(1, round(_SHARE * model.rate))
        self.every = max(1, round(_UPDATE * model.rate))
        self.chain = ArmChain(density, model.rate)
        rate = model.rate / self.every
        self.power = min(1.0, 1 / (rate * _SHARE_OF_TORSO))
        self.starts = 1 + max(1, round(_BEGINNING * rate))
        self.grid = derived(owner, ("root grid", rate), (like,), lambda: RootGrid(rate, like))
        info, (self.neck_between, self.middle_alone) = model.prior.info, model.middle
        hand = model.hand or info.hand
        neck = "mid-shoulder" if self.middle_alone else info.neck
        known = KnownBody(bone_lengths, height, person)
        self.lengths = derived(
            owner,
            ("body lengths", hand, neck, known.key),
            (like, prior.lengths, prior.spread),
            lambda: BodyLengths(prior, hand, neck, known, like),
        )
        self.optics = derived(
            owner,
            ("optics", info.fx, info.fy, info.cx, info.cy),
            (like,),
            lambda: Optics.of(info.matrix.to(like)),
        )
        self.root = RootStep(self.grid, self.chain, self.lengths)

    def init(
        self, batch_size: int, joints: ArmJoints, arm_generators: ArmGenerators
    ) -> ArticulatedState:
        """Return the state before the first frame; see `Estimator`."""
        begun = self._before_any_frame(batch_size)
        root = begun["root"]
        return ArticulatedState(
            **begun,
            roots=None,
            arms=None,
            middle=root.new_tensor([0.0, 0.0, 1.0]).expand(batch_size, -1),
            tilt=roll(lean_angle(begun["lean"])),
            frame=0,
            starts=torch.full((batch_size,), self.starts + 1, device=root.device),
        )

    def _before_any_frame(self, batch_size: int) -> dict[str, Any]:
        """Return what a state holds of torso and lengths before any frame."""
        root = self.grid.init(batch_size, self.lengths.size_spread)
        moments = self.grid.moments(root)
        lengths = self.lengths.init(batch_size, moments.of_size)
        return {
            "root": root,
            "seen_size": SeenSize.unknown(batch_size, root),
            "moments": moments,
            "lengths": lengths,
            "sizes": self.lengths.sizes(lengths),
            "lean": root.new_zeros(batch_size, 2),
        }

    def advance(
        self, state: ArticulatedState, measured: MeasuredJoints, progress: bool = False
    ) -> tuple[ArticulatedState, Estimates]:
        """Return the next state and the estimates of T more frames; see `Estimator`."""
        bones, memory = self._lifted(measured, state.memory)
        held = hold_hidden(measured, state.last, self.model.rate)
        steps, poses = self._steps(state, held, bones, progress), []
        while waiting := [*islice(steps, _AT_ONCE)]:
            state, told = waiting[-1].state, waiting[-1].state.told
            pose, told = self._poses([(step.seen, step.arms) for step in waiting], told)
            poses.append(pose)
            state = state._replace(told=told if len(waiting) == 1 else None)
        state = state._replace(memory=memory, last=held.last)
        return state, self._estimates(poses, held.measured)

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
            return self.filtered(measured, joints, arm_generators, lengths, progress)
        if self.ahead:
            measured = averaged_over_frames(measured, lengths, self.ahead)
        state = self.init(len(measured.uv), joints, arm_generators)
        bones, _ = self._lifted(measured, None)
        held = hold_hidden(measured, None, self.model.rate)
        steps = self._steps(state, held, bones, progress)
        seen, arms = zip(*((step.seen, step.arms) for step in steps), strict=True)
        lag = int(smoothing) - self.ahead if isinstance(smoothing, int) else None
        found = list(zip(seen, self.chain.smoothed(arms, lengths, lag), strict=True))
        parts = (found[i : i + _AT_ONCE] for i in range(0, len(found), _AT_ONCE))
        poses = [self._poses(part)[0] for part in parts]
        return repeat_last(self._estimates(poses, held.measured), lengths)

    def filtered(
        self,
        measured: MeasuredJoints,
        joints: ArmJoints,
        arm_generators: ArmGenerators,
        lengths: Tensor | None = None,
        progress: bool = False,
    ) -> Estimates:
        """Return the estimates of whole sequences without smoothing; see `Estimator.forward`."""
        return super().forward(measured, joints, arm_generators, lengths, progress)

    def _lifted(
        self, measured: MeasuredJoints, memory: Tensor | None
    ) -> tuple[LiftedBones | None, Tensor | None]:
        """Return what a network tells of bones in T frames, and what it remembers of them."""
        if measured.body is None:
            return None, None
        places, sure = measured.body
        matrix = self.optics.matrix
        rays = (places - matrix[:2, 2]) / matrix.diagonal()[:2]
        network, model = _network_on(rays.device), self.model
        return lift(network, rays, sure, model.rate, memory, model.pitch)

    def _steps(
        self,
        state: ArticulatedState,
        held: Held,
        bones: LiftedBones | None,
        progress: bool = False,
    ) -> Iterator[_Step]:
        """Yield the result of each frame."""
        measured = with_middle(held.measured) if self.middle_alone else held.measured
        rays = as_rays(measured, self.optics, bones, held.moved)
        facts = facts_of(rays, measured, self.optics.matrix)
        frames, batch_size = split(rays), len(measured.uv)
        sights = self._first_sights(state, rays.torso)
        with tqdm(total=len(frames), disable=not progress, desc="frames") as bar:
            for run in self._runs(state.frame, facts, batch_size, sights):
                for step in self._run(state, frames[run], facts[run.start]):
                    state = step.state
                    yield step
                bar.update(run.stop - run.start)

    def _first_sights(
        self, state: ArticulatedState, torso: Bool[Tensor, "B T 4"]
    ) -> Sequence[bool]:
        """Return in which of T frames two joints of anybody's torso are seen for the first time."""
        if state.starts is None:
            return [False] * torso.shape[1]
        two = (torso.sum(-1) > 1) & (state.starts > self.starts)[:, None]
        return (two & (two.cumsum(1) == 1)).any(0).tolist()

    def _runs(
        self, frame: int, facts: Sequence[Facts], batch_size: int, sights: Sequence[bool]
    ) -> list[slice]:
        """Return frames in a row of which the same holds, and in which only the first one changes the torso.

        A frame that the lengths of bones are learnt from, or that has no place of its own, stands alone.

        Args:
            frame: the number of the first one. facts: what holds for each. batch_size: B.
            sights: in which of them a torso is seen for the first time.
        """
        runs = [slice(0, 1)]
        for t in range(1, len(facts)):
            first, now = runs[-1].start, frame + t
            learns = now % self.stride == 0 or (now - 1) % self.stride == 0
            alike = facts[t].placed and facts[t].alike(facts[first])
            full = (t - first) * batch_size >= _BODIES_AT_ONCE
            if learns or now % self.every == 0 or sights[t] or not alike or full:
                runs.append(slice(t, t + 1))
            else:
                runs[-1] = slice(first, t + 1)
        return runs

    def _run(
        self, state: ArticulatedState, frames: Sequence[RayFrame], facts: Facts
    ) -> Iterator[_Step]:
        """Yield the results of some frames (`_runs`), computed in tilted axes, in which the torso is upright.

        Args:
            state: the state before the frames. frames: their measurements. facts: what holds for them.
        """
        due = state.roots is None or state.frame % self.every == 0
        first, fresh, again = self._starting(state, frames[0], due)
        if again is not None:
            state = self._without_past(state, again)
        state, before = self._leaning(state, frames[0], facts), state.moments
        tilted = upright(frames[0], facts, state.tilt)
        last = None if facts.placed else (state.middle[:, None] @ state.tilt)[:, 0]
        if due:
            state = self._with_torso(state, tilted, last, first, fresh)
        elif first is not None:
            state = _of_some(first, self._with_torso(state, tilted, last, first, fresh), state)
        roots = state.roots
        if roots is None:
            raise RuntimeError("the first frame is one that changes the torso")
        states = [state]
        for frame in frames[1:]:
            later = states[-1]._replace(frame=states[-1].frame + 1)
            states.append(self._leaning(later, frame, facts))
        # the arms, given the torso
        tilt = together([here.tilt for here in states])
        if len(frames) > 1:
            tilted = upright(together(frames), facts, tilt)
        root, sizes = together(len(frames) * [(roots.mean, state.sizes)])
        middle = self.root.middle(tilted, root, last, sizes)
        shoulders = shoulder_places(tilted, root, middle, sizes.torso.width)
        arms = self.root.arms(tilted, root, shoulders, sizes)
        lengths, learnt_sizes = self._learnt(state, tilted, root, shoulders)
        belief = state.arms
        found = apart((arms, middle, shoulders, (middle @ tilt.mT)[:, 0]), len(frames))
        for frame, here, own in zip(frames, states, found, strict=True):
            own_arms, own_middle, own_shoulders, place = own
            belief = (
                self.chain.start(own_arms, frame.limbs)
                if belief is None
                else self.chain.update(belief, own_arms, frame.limbs, again)
            )
            seen = _Seen(
                frame, facts, here.tilt, state.sizes, state.lengths, before, state.moments, roots,
                roots.mean, own_middle, own_shoulders,
            )  # fmt: skip
            after = here._replace(
                lengths=lengths, sizes=learnt_sizes, arms=belief, middle=place, frame=here.frame + 1
            )
            yield _Step(after, seen, belief)
            again, before = None, state.moments

    def _learnt(
        self,
        state: ArticulatedState,
        frame: UprightFrame,
        root: Root,
        shoulders: Float[Tensor, "B 2 1 3"],
    ) -> tuple[Lengths, Sizes]:
        """Return the belief over the lengths of bones after a frame, and the lengths; the same in most."""
        if state.frame % self.stride != 0:
            return state.lengths, state.sizes
        evidence = partial(self.root.evidence_of_lengths, frame, root, shoulders)
        learnt = self.lengths.learn(state.lengths, frame.torso, root, evidence)
        return learnt, self.lengths.sizes(learnt)

    def _leaning(self, state: ArticulatedState, frame: RayFrame, facts: Facts) -> ArticulatedState:
        """Return the state with the lean of the torso in a frame."""
        if not facts.leaning:
            return state
        joints = frame.rays[:, : len(UPPER_BODY)]
        lean = seen_lean(state.lean, joints, frame.known, state.moments.depth, self.model.rate)
        return state._replace(lean=lean, tilt=roll(lean_angle(lean)))

    def _with_torso(
        self,
        state: ArticulatedState,
        frame: UprightFrame,
        last: Float[Tensor, "B 3"] | None,
        first: Bool[Tensor, " B"] | None,
        fresh: Bool[Tensor, " B"] | None,
    ) -> ArticulatedState:
        """Return the state after an update of the torso: hypotheses of the root near the likeliest.

        Args:
            state: the state before. frame: the measurements. last: as in `RootStep.weigh`.
            first, fresh: which torsos are seen for the first time, and which bodies start with this frame;
                None is nobody.
        """
        power = torch.full_like(state.middle[:, 0], 1.0 if state.roots is None else self.power)
        for whole in (first, fresh):
            power = power if whole is None else power.masked_fill(whole, 1.0)
        size, farther = follow_size(state.seen_size, frame.torso, self.every / self.model.rate)
        belief, roots, fits = self.root.weigh(
            state.root, frame, last, state.sizes, power, fresh, _none_if_nobody(farther)
        )
        starts = state.starts
        if starts is not None and first is not None:
            starts = starts.masked_fill(first, self.starts)
        if starts is not None and fresh is not None and fits is not None:
            left = (starts - 1).masked_fill(fits, 0)
            starts = _none_if_nobody(torch.where(fresh, left, starts))
        moments = self.grid.moments(belief)
        return state._replace(
            root=belief, roots=roots, seen_size=size, moments=moments, starts=starts
        )

    def _starting(
        self, state: ArticulatedState, frame: RayFrame, due: bool
    ) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
        """Return which torsos are seen for the first time, and which bodies start, and start again.

        Args:
            state: the state before. frame: the measurements. due: whether it is time for an update of all.

        Returns:
            Three times which of the bodies, [B]; None is nobody.
        """
        if state.starts is None:
            return None, None, None
        two = frame.torso.sum(1) > 1
        first = two & (state.starts > self.starts)
        fresh = two & frame.limbs.flatten(1).any(1) & (state.starts > 0)
        fresh = fresh if due else fresh & first
        again = fresh & (state.starts < self.starts)
        return _none_if_nobody(first), _none_if_nobody(fresh), _none_if_nobody(again)

    def _without_past(
        self, state: ArticulatedState, chosen: Bool[Tensor, " B"]
    ) -> ArticulatedState:
        """Return the state in which torso and lengths of the chosen bodies are as before any frame."""
        begun = self._before_any_frame(len(chosen))
        fields = {
            name: where_rows(chosen, new, getattr(state, name)) for name, new in begun.items()
        }
        return state._replace(**fields)

    def _poses(
        self, found: Sequence[tuple[_Seen, ArmState]], told: _Told | None = None
    ) -> tuple[FramePose, _Told]:
        """Return the estimates of T frames of all B sequences at once, and what they hold of torsos.

        Args:
            found: what they are read from. told: that of the frame before, which most frames share.
        """
        seen, arms = together(found)
        told = self._told(seen, told)
        frame = upright(seen.frame, seen.facts, seen.tilt)
        body = SeenBody(
            joints=torso_joints(
                frame,
                seen.root,
                seen.middle,
                seen.shoulders[:, :, 0],
                seen.sizes.torso,
                self.grid.turn,
                self.neck_between,
            ),
            shoulders=seen.frame.torso[:, :2],
            limbs=seen.frame.seen,
            whole=seen.facts.whole,
            moved=seen.frame.moved,
            exact=seen.frame.exact,
            std=torch.where(seen.frame.known, seen.frame.std, 0.0),
            lengths=seen.sizes.metres,
            bones=told.bones,
            scale=self.lengths.scale.expand(len(seen.tilt)),
            others=told.others,
            far=seen.after.of_depth,
            axes=seen.root.axes[:, 0],
            tilt=seen.tilt,
        )
        pose = pose_of(body, arms, self.optics.log_focal, self.model.calibrated)
        return (pose if self.lengths.unit == 1.0 else enlarged(pose, self.lengths.unit)), told

    def _told(self, seen: _Seen, last: _Told | None) -> _Told:
        """Return what poses hold of torso and lengths, of which `last` keeps what is as it was."""
        if last is not None and seen.lengths is last.lengths and seen.before is last.before:
            bones = last.bones
        else:
            bones = self.lengths.shown(seen.lengths, seen.before.size, seen.before.of_size)
        if last is not None and seen.roots is last.roots and seen.sizes is last.sizes:
            others = last.others
        else:
            others = covs_of_roots(seen.roots, seen.sizes.metres)
        return _Told(seen.lengths, seen.before, bones, seen.roots, seen.sizes, others)

    def _estimates(self, poses: Sequence[FramePose], measured: MeasuredJoints) -> Estimates:
        return estimates_of(
            poses, len(measured.uv), self.optics.matrix, self.lengths.names, measured
        )


def _of_some(
    chosen: Bool[Tensor, " B"], new: ArticulatedState, old: ArticulatedState
) -> ArticulatedState:
    """Return the state in which an update of the torso is that of the chosen bodies alone."""
    names = ("root", "roots", "seen_size", "moments")
    fields = {name: where_rows(chosen, getattr(new, name), getattr(old, name)) for name in names}
    return new._replace(**fields)


def _none_if_nobody(chosen: Tensor) -> Tensor | None:
    """Return the same; None if it is false or 0 for everybody."""
    return chosen if bool(chosen.any()) else None


@cache
def _network_on(device: torch.device) -> LiftingNetwork:
    """Return the network that comes with the package, on a device, in double precision.

    In single precision a stream would have other numbers than the whole recording.
    """
    with outside_inference():
        return copy.deepcopy(shipped_lifting_network("upper-body")).to(device, torch.float64)


def _prior_of(owner: nn.Module, path: str | Path | None, like: Tensor) -> ArmPrior:
    """Return the prior of a file, read once for each tracker, or that of the package."""
    if not path:
        return shipped_arm_prior()
    return derived(owner, ("arm prior", str(path)), (like,), lambda: ArmPrior.load(path))
