"""Track hands by skin colour, mean shift and Kalman filters (Burke & Lasenby, section 5.2).

This is the paper's method, for all persons and both of their hands at once.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.images import Image
from torchpose._core.module_state import CpuModule
from torchpose.errors import InputError
from torchpose.math._gaussian import kalman_predict, kalman_update
from torchpose.measure._body_window import ScaledFrame, scale_frame, scales_of_faces
from torchpose.measure._hand_likelihood import (
    HandMeasurements,
    check_frame,
    no_hands,
    without_elbows,
)
from torchpose.measure._hand_prior import HandPrior
from torchpose.measure._mean_shift import mean_shift
from torchpose.measure._persons import match_states, measure_by_scale, take_rows
from torchpose.measure._skin import SkinModel, SkinState, parts_of_persons
from torchpose.priors._upper_body_prior import UpperBodyPrior

Likelihood = Literal["back-projection", "ratio"]
_THRESHOLDS = {"back-projection": 0.1, "ratio": 0.25}
# Lengths in sizes of the face.
_REACH = 4.5  # farthest hand from the face
_PLAUSIBLE = -4.5  # log density of the prior per squared size of the face
_VELOCITY = 0.1  # deviation of a new hand's, per frame
_LEAST_INSIDE = 0.25  # of a window, that must lie in the image
_HAND_RADIUS = 0.45  # of the disc whose colours are not learnt


class MeanShiftHandState(NamedTuple):
    """Holds the hands of N persons, left and right, pixels of the frame.

    Attributes:
        mean: (x, y) and velocity per frame [N, 2, 4]. cov: [N, 2, 4, 4]; both zero for a lost
            hand.
        tracked: [N, 2]. weak: frames in a row in which the likelihood was too low [N, 2].
        identity: number of each person [N]. skin: their colours.
    """

    mean: Float[Tensor, "N 2 4"]
    cov: Float[Tensor, "N 2 4 4"]
    tracked: Bool[Tensor, "N 2"]
    weak: Int[Tensor, "N 2"]
    identity: Int[Tensor, " N"]
    skin: SkinState


class _Look(NamedTuple):
    """Holds what mean shift finds of N persons in a frame; lengths in its pixels."""

    skin: SkinState
    centre: Float[Tensor, "N 2 2"]
    noise: Float[Tensor, "N 2 2 2"]
    average: Float[Tensor, "N 2"]
    seen: Bool[Tensor, "N 2"]


class MeanShiftHandTracker(CpuModule):
    """Tracks hands by mean shift in likelihood maps of skin.

    1. Likelihood: the histogram h of the face's colours is averaged over time and back-projected,
       l(x) = h(c(x)) / max h; face, neck and background are removed.
    2. A hand that is not tracked is searched for in its initialisation area: the person's left hand in
       the image to the right of the face, the right hand to the left of it.
    3. A constant-velocity Kalman filter predicts the window from which mean shift starts. The area
       predicted for the other hand is masked.
    4. A hand is lost when the average likelihood in its window is below a threshold, until it is
       found in its area again.

    Args:
        likelihood: "back-projection" of the face's histogram over a and b, as published, or "ratio",
            the probability of `SkinModel`, which compares the face with clothes and background.
        threshold: least average likelihood; by default 0.1 for the first kind and 0.25 for the second.
        patience: frames in a row below the threshold after which a hand is lost.
        window: side of the window. mask_radius: of the other hand's predicted area; 0 masks nothing.
        acceleration: deviation of the Kalman filter's process, per frame squared.
        spread: deviation of a found centre, in deviations of the likelihood in the window.
        skin: by default `SkinModel`. prior: over poses, or of hands given the face; search for lost hands
            wherever its density is high, weighted by it, instead of in the initialisation areas.

    All lengths are in sizes of the face. The frame is scaled down for every person such that the face
    has about 19 pixels; persons of one scale are one batch. Two things depend on the other persons:
    their heads are removed, and hands are initialised only in columns nearest to the own face.

    Raises:
        InputError: settings out of range.

    Reference:
        Burke & Lasenby, section 5.2. The ratio, the prior and the reach about the face are additions.

    Example:
        >>> import numpy as np, torch
        >>> from torchpose.measure._mean_shift_hands import MeanShiftHandTracker
        >>> frame = np.zeros((240, 320, 3), np.uint8)
        >>> frame[40:80, 140:180] = frame[180:200, 220:240] = (200, 150, 125)
        >>> face, identity = torch.tensor([[160.0, 60.0, 40.0]]), torch.tensor([0])
        >>> tracker = MeanShiftHandTracker()
        >>> state, hands = tracker.step(tracker.init(), frame, face, identity)
        >>> hands.seen.tolist(), [round(x, -1) for x in hands.points[0, 0].tolist()]
        ([[True, False]], [230.0, 190.0])
    """

    def __init__(
        self,
        likelihood: Likelihood = "back-projection",
        threshold: float | None = None,
        patience: int = 1,
        window: float = 0.8,
        mask_radius: float = 0.5,
        acceleration: float = 0.12,
        spread: float = 0.65,
        skin: SkinModel | None = None,
        prior: UpperBodyPrior | HandPrior | None = None,
    ) -> None:
        super().__init__()
        if likelihood not in _THRESHOLDS:
            raise InputError(f"likelihood must be one of {list(_THRESHOLDS)}, got {likelihood!r}")
        threshold = _THRESHOLDS[likelihood] if threshold is None else threshold
        if not 0 < threshold < 1 or patience < 1 or mask_radius < 0:
            raise InputError(
                "threshold must be in (0, 1), patience at least 1 and mask_radius not negative, got "
                f"{threshold}, {patience} and {mask_radius}"
            )
        if not min(window, acceleration, spread) > 0:
            raise InputError(
                "window, acceleration and spread must be positive, got "
                f"{window}, {acceleration} and {spread}"
            )
        self.likelihood, self.threshold, self.patience = likelihood, threshold, patience
        self.window, self.mask_radius = window, mask_radius
        self.acceleration, self.spread = acceleration, spread
        self.skin = SkinModel() if skin is None else skin
        self.prior = None if prior is None else HandPrior.from_prior(prior)
        eye = torch.eye(2, dtype=torch.float32)
        self.register_buffer("matrix", torch.kron(eye.new_tensor([[1.0, 1.0], [0.0, 1.0]]), eye))
        drive = torch.cat([0.5 * eye, eye])  # a constant acceleration within a frame
        self.register_buffer("drive", drive @ drive.mT)
        self.register_buffer("observed", torch.arange(2))

    matrix: Tensor
    drive: Tensor
    observed: Tensor

    def init(self) -> MeanShiftHandState:
        """Return the state without persons."""
        return take_rows(self._fresh(), slice(0, 0))

    def _fresh(self) -> MeanShiftHandState:
        """Return the state of one new person, without hands or colours."""
        mean, weak = self.matrix.new_zeros(1, 2, 4), torch.zeros(1, 2, dtype=torch.long)
        cov = self.matrix.new_zeros(1, 2, 4, 4)
        return MeanShiftHandState(mean, cov, weak > 0, weak, weak[:, 0], self.skin.init(1))

    def step(
        self,
        state: MeanShiftHandState,
        frame: Image,
        faces: Float[Tensor, "N 3"],
        identity: Int[Tensor, " N"],
        foreground: Image | None = None,
    ) -> tuple[MeanShiftHandState, HandMeasurements]:
        """Return the next state and the hands in the next frame.

        Args:
            state: from `init` or the step before. frame: RGB [H, W, 3], uint8.
            faces: centre (x, y) and size of the faces, pixels. identity: their numbers.
            foreground: [H, W], 0 where there is background; None is foreground everywhere.

        Returns:
            The next state, and `HandMeasurements` of N persons, pixels.

        Raises:
            ShapeError, InputError: frames, faces or masks of another kind.
        """
        check_frame(frame, faces, identity, foreground)
        faces = faces.to(self.matrix)
        state = match_states(state, self._fresh(), identity)
        if not len(faces):
            return state, no_hands(faces)
        state = self._predict(state, faces)

        def look(divisor: float, rows: Tensor) -> _Look:
            view = scale_frame(frame, foreground, faces, int(divisor), self.skin)
            return self._look(state, view, rows)

        skin, *found = measure_by_scale(scales_of_faces(faces, frame), look)
        centre, noise, average, seen = found
        state = self._update(state, centre, noise, seen, faces)._replace(skin=skin)
        return state, _measurements(state, centre, noise, average, seen)

    def _look(self, state: MeanShiftHandState, view: ScaledFrame, rows: Tensor) -> _Look:
        """Return the hands of some persons in an image that suits the size of their faces."""
        faces, tracked = view.faces[rows], state.tracked[rows]
        predicted = view.from_frame(state.mean[rows, :, :2])
        colours = take_rows(state.skin, rows)
        colours, skin = self._skin(colours, view.bins, faces, predicted, tracked)
        maps = self._without_the_other(skin * view.usable, predicted, tracked, faces)
        start, found = predicted, tracked
        if not bool(found.all()):
            start, found = self._detect(maps, view.faces, rows, tracked)
            start = torch.where(tracked[..., None], predicted, start)
        size = (self.window * faces[:, None, 2:]).expand(-1, 2, 2)
        rest = mean_shift(maps.flatten(0, 1), start.flatten(0, 1), size.flatten(0, 1))
        centre = rest.centre.view_as(start)
        average = rest.mass.view_as(found) / _area_inside(centre, size, maps.shape[2:])
        seen = (tracked | found) & (average >= self.threshold)
        noise = self._noise(rest.covariance.view(-1, 2, 2, 2), faces)
        noise = noise / view.scale / view.scale[:, None]
        return _Look(colours, view.to_frame(centre), noise, average, seen)

    def _predict(self, state: MeanShiftHandState, faces: Tensor) -> MeanShiftHandState:
        noise = (self.acceleration * faces[:, 2]).square()[:, None, None, None] * self.drive
        mean, cov = kalman_predict(
            state.mean,
            state.cov,
            self.matrix,
            torch.zeros_like(state.mean),
            noise.expand_as(state.cov),
        )
        return state._replace(mean=mean, cov=cov)

    def _skin(
        self, state: SkinState, bins: Tensor, faces: Tensor, predicted: Tensor, tracked: Tensor
    ) -> tuple[SkinState, Tensor]:
        """Return the colours after this frame, and the likelihood of skin [N, H, W]."""
        discs = _squared_distance(predicted, bins.shape)
        discs = discs < (_HAND_RADIUS * faces[:, 2]).square()[:, None, None, None]
        hands = (discs & tracked[..., None, None]).any(1).to(faces)
        of_each = bins.expand(len(faces), -1, -1)
        colours = self.skin.learn(state, of_each, parts_of_persons(faces, of_each.shape[1:]), hands)
        if self.likelihood == "ratio":
            return colours, self.skin.find(colours, of_each)
        histogram = colours.face.sum(1).flatten(1)  # over a and b: hands are lit otherwise
        histogram = histogram / histogram.amax(1, keepdim=True)
        return colours, histogram[:, bins.flatten() % histogram.shape[1]].view(of_each.shape)

    def _without_the_other(
        self, skin: Tensor, predicted: Tensor, tracked: Tensor, faces: Tensor
    ) -> Tensor:
        """Return the likelihood of each hand without the area predicted for the other [N, 2, H, W]."""
        other = _squared_distance(predicted, skin.shape[1:]).flip(1)
        masked = other < (self.mask_radius * faces[:, 2]).square()[:, None, None, None]
        masked = masked & tracked.flip(1)[..., None, None]
        return skin[:, None] * ~masked

    def _detect(
        self, maps: Tensor, faces: Tensor, rows: Tensor, tracked: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the best window where each hand may begin [N, 2, 2], and whether it is good enough.

        `faces` are of all persons, `rows` the persons of the maps.
        """
        height, width = maps.shape[2:]
        side = self.window * faces[rows, 2, None]
        across, down = _box_sums(width, side), _box_sums(height, side)
        average = down[:, None] @ maps @ across[:, None] / side.square()[..., None, None]
        area = self._areas(faces, rows, (height, width))
        usable = (average >= self.threshold) & (area > 0)
        best, place = torch.where(usable, average * area, -1.0).flatten(2).max(2)
        start = torch.stack([place % width, place // width], -1).to(faces)
        same = (start[:, 0] - start[:, 1]).norm(dim=1) < side[:, 0]  # one blob for both hands
        same = same & ~tracked.any(1)
        better = best >= best.amax(1, keepdim=True)
        return start, (best > 0) & (better | ~same[:, None])

    def _areas(self, faces: Tensor, rows: Tensor, shape: tuple[int, int]) -> Tensor:
        """Return the weight of each place for the left and the right hand [N, 2, H, W]."""
        x, y, size = faces[..., None].unbind(1)
        of_all = (torch.arange(shape[1]).to(faces) - x) / size
        across = of_all[rows]
        down = (torch.arange(shape[0]).to(faces) - y[rows]) / size[rows]
        # a person has the columns that are nearest to the own face
        own = (across.abs() == of_all.abs().amin(0))[:, None, None]
        if self.prior is None:
            halves = torch.stack([across > 0, across < 0], 1)[:, :, None]
            near = across.square()[:, None] + down.square()[..., None] < _REACH**2
            return (halves & near[:, None] & own).to(faces)
        grid = torch.stack(
            [across[:, None].expand(-1, shape[0], -1), down[..., None].expand(-1, -1, shape[1])], -1
        )
        log_density = self.prior(grid)[0].transpose(0, 1)
        likely = (log_density - log_density.amax((2, 3), keepdim=True)).exp()
        return torch.where(own & (log_density > _PLAUSIBLE), likely, 0.0)

    def _noise(self, moments: Tensor, faces: Tensor) -> Tensor:
        """Return the covariance of a centre from the second moments of the likelihood."""
        floor = (0.05 * faces[:, 2]).square()[:, None, None, None] * torch.eye(2).to(faces)
        return self.spread**2 * moments + floor

    def _update(
        self, state: MeanShiftHandState, centre: Tensor, noise: Tensor, seen: Tensor, faces: Tensor
    ) -> MeanShiftHandState:
        mask = (seen & state.tracked)[..., None].expand_as(centre)
        mean, cov, _ = kalman_update(state.mean, state.cov, centre, noise, self.observed, mask)
        born = (seen & ~state.tracked)[..., None]
        velocity = (_VELOCITY * faces[:, 2]).square()[:, None, None, None] * torch.eye(2).to(faces)
        zero = torch.zeros_like(noise)
        rows = torch.cat([noise, zero], -1), torch.cat([zero, velocity.expand_as(zero)], -1)
        mean = torch.where(born, torch.cat([centre, torch.zeros_like(centre)], -1), mean)
        cov = torch.where(born[..., None], torch.cat(rows, -2), cov)
        weak = torch.where(seen, 0, state.weak + 1)
        tracked = seen | (state.tracked & (weak < self.patience))
        mean = torch.where(tracked[..., None], mean, 0.0)
        cov = torch.where(tracked[..., None, None], cov, 0.0)
        return state._replace(mean=mean, cov=cov, tracked=tracked, weak=weak)


def _measurements(
    state: MeanShiftHandState, centre: Tensor, noise: Tensor, average: Tensor, seen: Tensor
) -> HandMeasurements:
    """Return the result of mean shift, with the sum of its covariance and the Kalman filter's."""
    points = torch.where(seen[..., None], centre, torch.nan)
    covariance = noise + torch.where(seen[..., None, None], state.cov[..., :2, :2], 0.0)
    return without_elbows(points, covariance, average.clamp(0, 1), seen)


def _squared_distance(points: Tensor, shape: Sequence[int]) -> Tensor:
    """Return the squared distance of every pixel from the points [N, 2, 2], as [N, 2, H, W]."""
    x, y = points[..., None, None].unbind(2)
    across = torch.arange(shape[1]).to(points) - x
    return across.square() + (torch.arange(shape[0]).to(points)[:, None] - y).square()


def _box_sums(length: int, side: Tensor) -> Tensor:
    """Return matrices [N, length, length] that sum over windows of the given sides [N, 1]."""
    place = torch.arange(length).to(side)
    away = (place[:, None] - place).abs()
    return (side[..., None] / 2 + 0.5 - away).clamp(0, 1)


def _area_inside(centre: Tensor, size: Tensor, shape: Sequence[int]) -> Tensor:
    """Return the area of each window inside the image, pixels, at least a quarter of the window."""
    last = torch.tensor([shape[1], shape[0]]).to(centre) - 0.5
    low, high = (centre - size / 2).clamp_min(-0.5), torch.minimum(centre + size / 2, last)
    return torch.maximum((high - low).clamp_min(0).prod(-1), _LEAST_INSIDE * size.prod(-1))
