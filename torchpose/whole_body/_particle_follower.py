"""Set up a particle filter; begin and follow one person with it, through silhouettes, keypoints, or both."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.checks import check_shape, check_tensors
from torchpose._core.module_state import derived
from torchpose._core.rows import joined
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.camera._rig import CameraRig
from torchpose.errors import InputError, NobodySeenError
from torchpose.filters._measurements import check_lengths
from torchpose.whole_body._body_arguments import check_kind, whole_length
from torchpose.whole_body._body_track import BodyTrack, repeat_last
from torchpose.whole_body._filter_table import LEARNT, METHODS, make_filter, rebased
from torchpose.whole_body._filters.body_particles import BodyFilterState
from torchpose.whole_body._filters.silhouette_filter import SilhouetteParticleFilter
from torchpose.whole_body._first_pose import find_first_pose
from torchpose.whole_body._following import Observed, follow, which_see
from torchpose.whole_body._keypoints.keypoint_likelihood import KeypointFrame
from torchpose.whole_body._keypoints.keypoint_notes import TOO_FEW, late_note
from torchpose.whole_body._measured_keypoints import (
    BodyKeypointMeasurer,
    GivenKeypoints,
    observed_frames,
)

_HEIGHT = 1.75  # metres, of a person of unknown height
_LOOK_AHEAD = 0.5  # seconds that decide where the person looks at first


@dataclass
class ParticleFollower:
    """Finds the first pose of a person, and follows it with a particle filter.

    Attributes:
        method: name of the filter, for errors. filter: over the poses of a body. cameras: theirs.
        fps: frames per second.
        start_body: the body with which the first pose is found; None for the filter's own.
        start_prior: the manifold in which it is looked for; None for the filter's own, if it has one.
        noise: of keypoints, metres and pixels; None for the usual ones. notes: on models that were rescaled.
    """

    method: str
    filter: SilhouetteParticleFilter
    cameras: CameraRig
    fps: float
    start_body: Body | None
    start_prior: Any
    noise: tuple[float | None, float | None]
    notes: tuple[str, ...]

    @property
    def upright(self) -> Body:
        """Return the body on which the first pose is looked for."""
        own: Any = self.filter.body
        return own if self.start_body is None else self.start_body

    @property
    def looked_at(self) -> int:
        """Return the number of frames in which the first pose is found."""
        return max(1, round(_LOOK_AHEAD * self.fps))

    @property
    def measurer(self) -> BodyKeypointMeasurer:
        """Return what makes measurements of keypoints; it is set up by the first ones."""
        sources = (*self.upright.buffers(), *self.cameras.buffers())
        return derived(
            self.filter, "measurer", sources,
            lambda: BodyKeypointMeasurer(self.cameras, self.fps, self.upright, *self.noise),
        )  # fmt: skip

    def track(
        self,
        silhouettes: Iterable[Tensor] | None,
        given: GivenKeypoints | None,
        initial_state: Tensor | None,
        initial_cov: Tensor,
        generator: torch.Generator | None,
        *,
        facing: Tensor | None,
        lengths: Tensor | None,
        n_frames: int | None,
        progress: bool,
    ) -> BodyTrack:
        """Track a whole sequence, as `BodyTracker.forward`."""
        source, measured = self.observed(silhouettes, given)
        frames = source if lengths is None else islice(source, whole_length(lengths))
        begun, first = self.first_seen(frames, measured)
        looked_at = 1 if initial_state is not None else self.looked_at
        begin = [first, *islice(frames, looked_at - 1)]
        if initial_state is None:
            initial_state = self.first_state(begin, generator, facing)
        state = self.begin(initial_state, initial_cov, generator)
        expected = None if n_frames is None else max(1, n_frames - begun)
        bar = tqdm(chain(begin, frames), total=expected, disable=not progress, unit="frame")
        poses = self.follow(state, iter(bar), generator, begun)[1]
        if lengths is not None:
            there, later = begun + len(poses), sum(1 for _ in source)
            check_lengths(lengths, 1, there + later, lengths.device)
            poses = repeat_last(poses, later)
        unseen = "not all cameras saw somebody" if measured is None else TOO_FEW
        poses.notes += late_note(begun, unseen)
        return poses

    def observed(
        self,
        silhouettes: Iterable[Any] | None,
        given: GivenKeypoints | None,
        fitting: bool = False,
    ) -> tuple[Iterator[Observed], KeypointFrame | None]:
        """Return the frames one after the other, and the keypoints of all of them.

        Args:
            silhouettes: [C, H, W], frame after frame. given: keypoints of as many frames.
            fitting: as `KeypointReader.frames_and_feet`.

        Raises:
            InputError: neither of them, or keypoints beside a likelihood of one's own.
        """
        if given is None:
            if silhouettes is None:
                raise InputError(
                    f"method {self.method} takes silhouettes, keypoints or both, got none"
                )
            return map(Observed, self._frames(silhouettes)), None
        if callable(self.filter.likelihood):
            raise InputError(
                "a callable likelihood takes observations of its own; leave out the keypoints"
            )
        measured = self.measurer.measured(given, fitting)
        outlined = None if silhouettes is None else self._frames(silhouettes)
        return observed_frames(outlined, self.measurer, measured), measured

    def _frames(self, silhouettes: Iterable[Any]) -> Iterator[Tensor]:
        """Return the frames of silhouettes; `InputError` or `ShapeError` for what are none, when it comes."""
        if isinstance(silhouettes, str | Path) or not isinstance(silhouettes, Iterable):
            raise InputError(
                "silhouettes must be a tensor [T, C, H, W] or frames [C, H, W], got "
                f"{type(silhouettes).__name__}; read_silhouettes makes them of videos"
            )
        plain = not callable(self.filter.likelihood)

        def checked(frame: Any) -> Tensor:
            check_tensors(silhouettes=frame)
            if plain:
                check_shape("a frame of silhouettes", frame, ["C", "H", "W"])
                self.cameras.check_images("silhouettes", frame.shape)
            return frame

        return map(checked, silhouettes)

    def first_seen(
        self, frames: Iterator[Observed], measured: KeypointFrame | None
    ) -> tuple[int, Observed]:
        """Return the number of the first frame in which the person is seen well enough, and that frame.

        Raises:
            NobodySeenError: there is none.
        """
        begun = 0 if measured is None else self.measurer.first_frame(measured)
        saw: set[int] = set()  # of what a callable takes there may be as many as it likes
        for t, one in islice(enumerate(frames), begun, None):
            if measured is not None:
                return t, one
            seeing = which_see(_masks(one))
            if bool(seeing.all()):
                return t, one
            saw.update(seeing.nonzero().flatten().tolist())
        blind = [name for c, name in enumerate(self.cameras.names) if c not in saw]
        raise NobodySeenError(
            "nobody is seen by all cameras in any frame"
            + (f", and by {', '.join(blind)} in none" if blind else "")
            + "; check the silhouettes, or leave out a camera that sees nobody"
        )

    def first_state(
        self, frames: Sequence[Observed], generator: torch.Generator | None, facing: Tensor | None
    ) -> Float[Tensor, " D"]:
        """Return the pose of the filter's body in the first of some frames: from keypoints if there are any.

        Args:
            frames: of half a second. generator: of random numbers. facing: where the person looks at first.
        """
        keypoints = [one.keypoints.frame for one in frames if one.keypoints is not None]
        if keypoints:
            found = self.measurer.first_pose(joined(keypoints))
        else:
            prior = self.start_prior
            prior = getattr(self.filter, "manifold", None) if prior is None else prior
            found = find_first_pose(
                self.upright, torch.stack([_masks(one) for one in frames]), self.cameras, prior,
                generator, fps=self.fps, facing=facing,
            ).state  # fmt: skip
        own: Any = self.filter.body
        return found if self.start_body is None else self.start_body.convert(found, own)

    def begin(
        self, initial_state: Tensor, initial_cov: Tensor, generator: torch.Generator | None
    ) -> BodyFilterState:
        """Return the state before the first frame, of the pose [D] of the filter's body."""
        body: Any = self.filter.body
        check_tensors(initial_state=initial_state)
        check_shape("initial_state", initial_state, [body.dim])
        return self.filter.init(initial_state[None], generator=generator, initial_cov=initial_cov)

    def follow(
        self,
        state: BodyFilterState,
        frames: Iterable[Observed],
        generator: torch.Generator | None,
        first_frame: int,
    ) -> tuple[BodyFilterState, BodyTrack]:
        """Return the state after some frames, and the poses in them."""
        after, poses = follow(self.filter, state, frames, self.cameras, generator, first_frame)
        poses.fps, poses.method = self.fps, self.method
        poses.notes = (*self.notes, *poses.notes)
        return after, poses


def _masks(one: Observed) -> Tensor:
    """Return the silhouettes of a frame that has them."""
    if one.silhouettes is None:
        raise InputError("expected silhouettes, got none")
    return one.silhouettes


# --- set-up ---------------------------------------------------------------------------------------


def set_up_particles(
    method: str,
    rig: CameraRig,
    given: Mapping[str, Any],
    body: Body | None,
    height: float | None,
    fps: float,
    n_particles: int,
    options: Mapping[str, Any],
    noise: tuple[float | None, float | None],
) -> ParticleFollower:
    """Return the filter of a method with what finds its first pose.

    Args:
        method: among `METHODS`. rig: the cameras. given: models, names or files by kind.
        options: of the filter. noise: of keypoints, metres and pixels.
        body, height, fps, n_particles: as `BodyTracker`.
    """
    found = {kind: _model(kind, value, fps) for kind, value in given.items()}
    models = {kind: model for kind, (model, _) in found.items()}
    if body is None:
        body = Body.of_height(BODY_15, _HEIGHT if height is None else height)
    person = rebased(body, "parent", None)
    upright, tracked, learnt = _bodies(method, person, models)
    particles = make_filter(method, tracked, learnt, fps, n_particles, options)
    own = METHODS[method].needs == "manifold"  # then the filter holds it
    manifold = None if own else models.get("manifold")
    notes = tuple(note for _, note in found.values() if note)
    start_body = None if upright is tracked else upright  # so that its tensors are held once
    return ParticleFollower(method, particles, rig, fps, start_body, manifold, noise, notes)


def _model(kind: str, value: Any, fps: float) -> tuple[Any, str]:
    """Return a model with its noise for a frame rate, and notes about it."""
    check_kind(kind, value, *LEARNT[kind].types)
    model = LEARNT[kind].load(value) if isinstance(value, str | Path) else value
    return LEARNT[kind].at_rate(model, fps), LEARNT[kind].rescaled(model, fps)


def _bodies(method: str, person: Body, models: dict[str, Any]) -> tuple[Body, Body, Any]:
    """Return the body with which the first pose is found, the one that is tracked, and the method's model."""
    upright, needs = person, METHODS[method].needs
    if "manifold" in models:
        upright = LEARNT["manifold"].body(person, models["manifold"])
    if needs is None:
        return upright, person, None
    tracked = upright if needs == "manifold" else LEARNT[needs].body(person, models[needs])
    return upright, tracked, models[needs]
