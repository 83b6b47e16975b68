"""Track both hands of every person in colour video by a histogram filter (after Burke & Lasenby, 5.2)."""

import math
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import interpolate

from torchpose._core.images import Image
from torchpose.errors import InputError
from torchpose.measure._background import Motion, MotionState
from torchpose.measure._body_window import (
    CELL,
    CELLS,
    COLOURS,
    EVIDENCE,
    cell_axes,
    cell_centres,
    cells_to_pixels,
    cut_colours,
    cut_mask,
    faces_in_evidence,
    faces_in_window,
    follow_faces,
    inside_image,
    move_maps,
    pixels_to_cells,
    place_windows,
)
from torchpose.measure._grid_filter import exclude, gaussian_bump, predict, read_out
from torchpose.measure._hand_elbows import expected_elbows, find_elbows, in_frame
from torchpose.measure._hand_likelihood import (
    HandLikelihood,
    HandMeasurements,
    HandSettings,
    check_frame,
    no_hands,
    without_elbows,
)
from torchpose.measure._hand_network import HandNetwork, HandPlaces
from torchpose.measure._hand_prior import HandPrior
from torchpose.measure._head import FaceMemory, FaceMemoryState, head_part
from torchpose.measure._persons import match_states, take_rows
from torchpose.measure._skin import SkinModel, SkinState

__all__ = ["HandState", "HandTracker"]

_REACH = -5.2  # log density per B squared above which a hand may be in a place
_FACE = (0.7, 0.9)  # half the width and height of a face with its surroundings, in B
_NEAR = 4  # cells about a hand that belong to it
_UNKNOWN, _SUREST = 0.5, 1e-3  # probability that a hand is gone: at first, and at the least


class HandState(NamedTuple):
    """Holds the state of N persons, the first dimension of every tensor.

    Attributes:
        identity: number of each person. anchors: of the windows (x, y, B), pixels.
        skin, memory, motion: of the parts.
        belief: probability of each hand in each cell, if it is seen; sums to one [N, 2, 88, 96].
        gone: probability that each hand is not to be seen [N, 2].
        size: B, slowly averaged, pixels.
        place: of the hands in the last frame, pixels. speed: pixels per frame.
        frames: seen so far.
    """

    identity: Int[Tensor, " N"]
    anchors: Float[Tensor, "N 3"]
    skin: SkinState
    memory: FaceMemoryState
    motion: MotionState
    belief: Float[Tensor, "N 2 h w"]
    gone: Float[Tensor, "N 2"]
    size: Float[Tensor, " N"]
    place: Float[Tensor, "N 2 2"]
    speed: Float[Tensor, "N 2 2"]
    frames: Int[Tensor, " N"]


class HandTracker(nn.Module):
    """Tracks both hands of every person by a histogram filter in a window about the face.

    The likelihood of a hand comes from skin (against clothes and background), motion and the shape
    of a hand at the end of its forearm (`HandLikelihood`). Its prior is that over poses, given the face
    (`HandPrior`). The face is removed from the skin unless it changes (`FaceMemory`). The belief is
    predicted by optical flow, by its own velocity and by diffusion, and the two hands exclude each
    other (`predict`, `exclude`). A frame without motion has little weight. The hands of a frame are
    returned with that frame, without delay.

    With a network the log-likelihood is a sum of two, and a hand may be gone: hidden, or outside of the
    image. That is a state of its own, beside the places, with a probability that is filtered over time.
    The network also finds the elbows, in each frame alone.

    Args:
        prior: of hands given the face.
        settings: constants. fps: frames per second of the video.
        network: that tells hands from what looks alike; None leaves it to colours, motion and shape, and
            takes every hand to be somewhere.
        elbows: whether the network also finds the elbows.

    Raises:
        InputError: a frame rate that is not positive.

    Reference:
        Burke & Lasenby, section 5.2, for the task and the skin; the filter goes beyond it.

    Example:
        >>> import numpy as np, torch, torchpose
        >>> from torchpose.measure import HandTracker
        >>> from torchpose.measure._hand_prior import HandPrior
        >>> tracker = HandTracker(HandPrior.from_prior(torchpose.load_prior("kinect-upper-body")))
        >>> frame = np.full((120, 160, 3), 90, np.uint8)
        >>> face, number = torch.tensor([[80.0, 30.0, 20.0]]), torch.tensor([0])
        >>> state, hands = tracker.step(tracker.init(), frame, face, number)
        >>> hands.points.shape
        torch.Size([1, 2, 2])
    """

    def __init__(
        self,
        prior: HandPrior,
        settings: HandSettings | None = None,
        fps: float = 30.0,
        network: HandNetwork | None = None,
        elbows: bool = True,
    ) -> None:
        super().__init__()
        if not (math.isfinite(fps) and fps > 0):
            raise InputError(f"fps must be positive, got {fps}")
        self.prior, self.settings, self.fps = prior, settings or HandSettings(), fps
        s, rate = self.settings, 30.0 / fps
        self.rate, self.network, self.elbows = rate, network, elbows
        self.skin = SkinModel(
            s.skin_slope, s.skin_bias, s.skin_decay**rate, s.skin_floor, s.clothes_share
        )
        self.memory = FaceMemory(
            s.face_deviations, s.face_floor, s.face_median, s.face_scale,
            align=s.face_alignment, rate=rate, remember=s.face_memory,
        )  # fmt: skip
        self.motion = Motion(rate=rate, flow=s.flow > 0)
        self.likelihood = HandLikelihood(
            s.disc, s.core, s.motion, s.unusual, s.beyond, s.towards, s.beside,
            unknown=s.unknown_skin,
        )  # fmt: skip

    def init(self) -> HandState:
        """Return the state without persons."""
        return take_rows(self._fresh(torch.zeros(1, 3)), slice(0, 0))

    @torch.no_grad()
    def step(
        self,
        state: HandState,
        frame: Image,
        faces: Float[Tensor, "N 3"],
        identity: Int[Tensor, " N"],
        foreground: Image | None = None,
        expected: tuple[Float[Tensor, "N 2 2"], Float[Tensor, "N 2 2 2"]] | None = None,
    ) -> tuple[HandState, HandMeasurements]:
        """Return the next state and the hands in the next frame.

        Args:
            state: from `init` or the step before; its persons are matched by number.
            frame: RGB [H, W, 3].
            faces: (x, y, B), pixels. identity: number of each face.
            foreground: [H, W], 255 where the image is not background.
            expected: mean and covariance of the hands as a pose filter predicts them, pixels; NaN
                where unknown. Hands are reinitialised there too.

        Returns:
            The next state, with the persons of this frame, and their hands.

        Raises:
            InputError: another kind of image, or faces without a size. ShapeError: wrong shapes.
        """
        check_frame(frame, faces, identity, foreground)
        faces = faces.double()
        if not len(faces):
            return self.init(), no_hands(faces)
        state, new = self._persons(state, faces, identity)
        state, faces = self._steady(state, faces)
        state = self._follow(state, faces)
        inside = inside_image(state.anchors, frame.shape[1], frame.shape[0], EVIDENCE)
        state, means, flow, found = self._evidence(state, frame, faces, inside, foreground)
        log_prior, elbow = self._prior(faces, state.anchors)
        log_likelihood = self.likelihood(means, elbow) + self.settings.prior * log_prior
        if found is not None:
            log_likelihood = self.settings.beside_network * log_likelihood + found.log_prob
            state = state._replace(gone=self._gone(state.gone, found.gone))
        rebirth = self._rebirth(log_prior, faces, state.anchors, expected)
        belief = torch.where(new[:, None, None, None], rebirth, state.belief)
        reach = log_prior.amax(1) > _REACH
        moving = (means[:, 2] * reach).sum((1, 2)) * CELL**2 / self.settings.still_motion
        still = self.settings.still
        moves = still + (1 - still) * moving.clamp(0, 1)
        belief = self._filter(state, belief, rebirth, log_likelihood, moves, flow)
        state, hands = self._measure(state._replace(belief=belief), means[:, 1], frame.shape)
        if found is not None and self.elbows:
            expected_elbow = expected_elbows(hands, elbow, state.anchors)
            elbows = find_elbows(found, expected_elbow, state.anchors, frame.shape, self.settings)
            hands = hands._replace(
                elbows=elbows.points, elbow_covariance=elbows.covariance, elbow_seen=elbows.seen
            )
        return state, hands

    def _persons(
        self, state: HandState, faces: Tensor, identity: Tensor
    ) -> tuple[HandState, Tensor]:
        """Return the state of the persons of this frame, and which of them are new."""
        if not torch.equal(state.identity, identity):
            new = ~torch.isin(identity, state.identity)
            anchors = place_windows(faces)
            state = match_states(state, self._fresh(anchors[:1]), identity)
            anchors = torch.where(new[:, None], anchors, state.anchors)
            state = state._replace(anchors=anchors)
        return state, state.frames == 0

    def _steady(self, state: HandState, faces: Tensor) -> tuple[HandState, Tensor]:
        """Return the faces with averaged sizes: a hand in front of a face changes its bounding box only."""
        follow = torch.clamp(1 / (state.frames + 1.0), min=self.settings.face_follow * self.rate)
        off = (faces[:, 2] / state.size).log().abs() > math.log(self.settings.face_change)
        follow = torch.where(off, 1.0, follow.clamp(max=1.0))
        size = state.size.lerp(faces[:, 2], follow.to(faces))
        return state._replace(size=size), torch.cat([faces[:, :2], size[:, None]], 1)

    def _fresh(self, anchors: Tensor) -> HandState:
        n = len(anchors)
        number = torch.zeros(n, dtype=torch.long)
        nowhere = torch.full((n, 2, 2), torch.nan, dtype=torch.float64)
        even = torch.full((n, 2, *CELLS), 1 / math.prod(CELLS))
        return HandState(
            number, anchors.double(), self.skin.init(n), self.memory.init(n), self.motion.init(n),
            even, torch.full((n, 2), _UNKNOWN if self.network else 0.0), anchors[:, 2].double(),
            nowhere, torch.zeros_like(nowhere), number.clone(),
        )  # fmt: skip

    def _follow(self, state: HandState, faces: Tensor) -> HandState:
        """Return the state in windows that follow their faces."""
        s = self.settings
        anchors, moved = follow_faces(state.anchors, faces, s.stray, s.rescale)
        if not bool(moved.any()):
            return state
        motion = self.motion.move(state.motion, state.anchors, anchors, moved)
        belief = state.belief.clone()
        kept = move_maps(belief[moved], state.anchors[moved], anchors[moved]) + 1e-9
        belief[moved] = kept / kept.sum((2, 3), keepdim=True)
        return state._replace(anchors=anchors, motion=motion, belief=belief)

    def _evidence(
        self,
        state: HandState,
        frame: Image,
        faces: Tensor,
        inside: Tensor,
        foreground: Image | None,
    ) -> tuple[HandState, Tensor, Tensor, HandPlaces | None]:
        """Return the next state, the likelihood's means in every cell, the flow, and the network's places."""
        lab, smooth, head = cut_colours(frame, state.anchors, head_part(COLOURS))
        hands = _hands_near(state.belief) * (state.frames > 0)[:, None, None]
        bins = self.skin.byte_bins(lab)
        learnt = self.skin.learn(
            state.skin,
            bins,
            faces_in_evidence(faces, state.anchors),
            interpolate(hands[:, None], scale_factor=float(EVIDENCE))[:, 0],
            inside > 0.5,
        )
        skin = self.skin.find(learnt, bins)
        memory, hidden = self.memory.step(state.memory, head, faces, state.anchors, hands)
        rows, columns = head_part(EVIDENCE)
        skin[:, rows, columns] *= 1 - hidden
        if foreground is not None:
            skin = skin * cut_mask(foreground, state.anchors)
        motion, moving, unusual, flow = self.motion.step(state.motion, smooth, lab[:, 0])
        maps = torch.stack([skin, moving, unusual], 1)
        if bool((inside < 1).any()):
            maps = maps * inside[:, None]
            maps[:, 0] += self.likelihood.unknown * (1 - inside)
        means = self.likelihood.means(maps)
        found = None
        if self.network is not None:
            near = faces_in_window(faces, state.anchors)
            found = self.network.find(lab, maps, inside, near, self.elbows)
        return state._replace(skin=learnt, memory=memory, motion=motion), means, flow, found

    def _gone(
        self, before: Float[Tensor, "N 2"], log_odds: Float[Tensor, "N 2"]
    ) -> Float[Tensor, "N 2"]:
        """Return the probability that hands are gone: a chain of two states, and a tempered likelihood."""
        s = self.settings
        predicted = 0.5 + (2 * s.gone_stay - 1) ** self.rate * (before - 0.5)
        odds = torch.logit(predicted) + s.gone_weight * (log_odds + s.gone_bias)
        return torch.sigmoid(odds).clamp(_SUREST, 1 - _SUREST)

    def _prior(self, faces: Tensor, anchors: Tensor) -> tuple[Tensor, Tensor]:
        """Return log density [N, 2, r, c] and expected elbow [N, 2, 2, r, c], in B from the anchor."""
        near = faces_in_window(faces, anchors)
        at, size = near[:, None, None, :2], near[:, 2, None, None, None]
        log_density, elbow = self.prior((cell_centres() - at) / size)
        elbow = elbow.movedim(2, 0) * size[:, None] + at.permute(0, 3, 1, 2)[:, None]
        return log_density.movedim(1, 0), elbow

    def _rebirth(
        self,
        log_prior: Tensor,
        faces: Tensor,
        anchors: Tensor,
        expected: tuple[Tensor, Tensor] | None,
    ) -> Tensor:
        """Return the density from which lost hands are reinitialised, low in front of the face."""
        cost = self.settings.face_rebirth * _before_face(faces, anchors)[:, None]
        born = torch.softmax((log_prior - cost).flatten(2), 2).view_as(log_prior)
        if expected is None:
            return born
        mean, cov = (x.double() for x in expected)
        known = torch.isfinite(mean).all(-1) & torch.isfinite(cov).all((-1, -2))
        mean = torch.where(known[..., None], mean, 0.0)
        unit = (anchors[:, 2] * CELL).square()[:, None, None, None]
        eye = torch.eye(2, dtype=cov.dtype)
        cov = torch.where(known[..., None, None], cov / unit, eye) + 0.25 * eye
        bump = gaussian_bump(pixels_to_cells(mean, anchors), cov, CELLS).to(born)
        share = self.settings.expected_share * known[..., None, None]
        return born + share.to(born) * (bump - born)

    def _filter(
        self,
        state: HandState,
        belief: Tensor,
        rebirth: Tensor,
        log_likelihood: Tensor,
        moves: Tensor,
        flow: Tensor,
    ) -> Tensor:
        s, rate = self.settings, self.rate
        speed = (state.speed / (state.anchors[:, 2:, None] * CELL)).float()
        predicted = predict(
            belief, rebirth, speed, flow, moves,
            near=s.near / CELL * rate, far=s.far / CELL * rate, near_share=s.near_share,
            flow_share=s.flow, flow_blur=s.flow_blur / CELL, jump=1 - (1 - s.jump) ** rate,
            rest=s.rest / CELL,
        )  # fmt: skip
        best = log_likelihood.amax((2, 3), keepdim=True)
        weight = (moves[:, None, None, None] * (log_likelihood - best)).clamp_min(-30).exp()
        exclusion, crossing = s.exclusion, s.crossing
        if self.network is not None:
            exclusion, crossing = s.exclusion_beside_network, s.crossing_beside_network
        return exclude(
            predicted * weight,
            exclusion, s.exclusion_radius / CELL, crossing, s.crossing_soft / CELL,
        )  # fmt: skip

    def _measure(
        self, state: HandState, skin: Tensor, shape: tuple[int, ...]
    ) -> tuple[HandState, HandMeasurements]:
        s, anchors = self.settings, state.anchors
        found = read_out(state.belief, smooth=1.5, within=5.0)
        points = cells_to_pixels(found.place, anchors)
        unit = (anchors[:, 2] * CELL).square()[:, None, None, None]
        floor = (s.covariance_floor / CELL) ** 2 * torch.eye(2, dtype=unit.dtype)
        covariance = (s.covariance_scale * found.covariance + floor) * unit
        there = in_frame(points, shape)
        cell = found.mode[..., 1] * CELLS[1] + found.mode[..., 0]
        here = skin.flatten(1).gather(1, cell)
        seen = there & (found.mass >= s.least_mass) & (here >= s.least_skin)
        seen = seen & (state.gone < s.most_gone)
        covariance = covariance / (1 - state.gone)[..., None, None]
        step = points - state.place
        most = 5 * CELL * anchors[:, 2, None, None] * self.rate
        step = torch.minimum(torch.maximum(step, -most), most).nan_to_num_(0.0)  # none at first
        speed = state.speed.lerp(step * s.velocity, 0.5)
        shown = torch.where(there[..., None], points, torch.nan)
        state = state._replace(place=points, speed=speed, frames=state.frames + 1)
        absent = None if self.network is None else state.gone.to(shown)
        return state, without_elbows(shown, covariance, found.mass, seen, absent)


def _before_face(faces: Tensor, anchors: Tensor) -> Tensor:
    """Return a map that is one on the face and zero away from it [N, r, c]."""
    at, (x, y) = faces_in_window(faces, anchors), cell_axes()
    across = ((x - at[:, :1]) / (at[:, 2:] * _FACE[0])).square()
    down = ((y - at[:, 1:2]) / (at[:, 2:] * _FACE[1])).square()
    return torch.sigmoid(6 * (1 - (across[:, None] + down[:, :, None])))


def _hands_near(belief: Tensor) -> Tensor:
    """Return the probability that a cell belongs to a hand [N, r, c]."""
    rows, columns = (_band(n) for n in CELLS)
    return (rows @ belief.sum(1) @ columns).clamp(0, 1)


@cache
def _band(size: int) -> Tensor:
    place = torch.arange(size)
    return ((place[:, None] - place).abs() <= _NEAR).float()
