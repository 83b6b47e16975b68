"""Track both hands of every person in colour video by a histogram filter (after Burke & Lasenby, 5.2)."""

import math
from functools import cache
from typing import NamedTuple, Self

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import interpolate

from torchpose._core.images import Image
from torchpose._core.module_state import CpuModule, outside_inference
from torchpose.errors import InputError
from torchpose.measure._background import Motion
from torchpose.measure._body_window import (
    CELL,
    CELLS,
    EVIDENCE,
    cells_to_pixels,
    halve,
    move_maps,
    pixels_to_cells,
)
from torchpose.measure._grid_filter import exclude, gaussian_bump, predict, read_out, without_jumps
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
from torchpose.measure._hand_windows import HandView, HandWindows, HandWindowState
from torchpose.measure._head import FaceMemory, FaceMemoryState, head_part
from torchpose.measure._persons import match_states, take_rows
from torchpose.measure._skin import SkinModel, SkinState
from torchpose.priors._upper_body_prior import UpperBodyPrior

_NEAR = 4  # cells about a hand that belong to it
_UNKNOWN, _SUREST = 0.5, 1e-3  # probability that a hand is gone: at first, and at the least


class HandBeliefs(NamedTuple):
    """Holds what is believed of N persons, the first dimension of every tensor.

    Attributes:
        identity: number of each person. skin, memory: of the parts.
        cells: probability of each hand in each cell, if it is seen; sums to one [N, 2, 88, 96].
        gone: probability that each hand is not to be seen [N, 2].
        place: of the hands in the last frame, pixels. speed: pixels per frame.
        frames: seen so far.
    """

    identity: Int[Tensor, " N"]
    skin: SkinState
    memory: FaceMemoryState
    cells: Float[Tensor, "N 2 h w"]
    gone: Float[Tensor, "N 2"]
    place: Float[Tensor, "N 2 2"]
    speed: Float[Tensor, "N 2 2"]
    frames: Int[Tensor, " N"]


class HandState(NamedTuple):
    """Holds the windows about the faces of some persons, and what is believed of their hands."""

    windows: HandWindowState
    beliefs: HandBeliefs


class HandTracker(CpuModule):
    """Tracks both hands of every person by a histogram filter in a window about the face.

    The likelihood of a hand comes from skin (against clothes and background), motion and the shape
    of a hand at the end of its forearm (`HandLikelihood`). Its prior is that over poses, given the face
    (`HandPrior`). The face is removed from the skin unless it changes (`FaceMemory`). The belief is
    predicted by optical flow, by its own velocity and by diffusion, and the two hands exclude each
    other (`predict`, `exclude`). A frame without motion has little weight. The hands of a frame are
    returned with that frame, without delay.

    With a network the log-likelihood is a sum of two, and a hand may be gone: hidden, or outside of the
    image. That is a state of its own, beside the places, with a probability that is filtered over time.
    The network takes either hand for the other one, so a hand that was seen elsewhere comes to the other
    one by moving only (`without_jumps`).
    The network also finds the elbows, in each frame alone.

    `step` is `look`, which the images and faces alone decide and which may run ahead, and then `find`.

    Args:
        prior: the prior over poses, which gives that of hands given the face, or the latter itself.
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
        >>> tracker = HandTracker(torchpose.load_prior("kinect-upper-body"))
        >>> frame = np.full((120, 160, 3), 90, np.uint8)
        >>> face, number = torch.tensor([[80.0, 30.0, 20.0]]), torch.tensor([0])
        >>> state, hands = tracker.step(tracker.init(), frame, face, number)
        >>> hands.points.shape
        torch.Size([1, 2, 2])
    """

    def __init__(
        self,
        prior: UpperBodyPrior | HandPrior,
        settings: HandSettings | None = None,
        fps: float = 30.0,
        network: HandNetwork | None = None,
        elbows: bool = True,
    ) -> None:
        super().__init__()
        if not (math.isfinite(fps) and fps > 0):
            raise InputError(f"fps must be positive, got {fps}")
        self.prior = prior = HandPrior.from_prior(prior)
        self.settings, self.fps = settings or HandSettings(), fps
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
        self.windows = HandWindows(s, rate, prior, self.skin, self.motion, self.likelihood, network)

    def train(self, mode: bool = True) -> Self:
        """Set the mode, as a model in training does, of all but the network, which learns nothing here.

        Args:
            mode: whether the model trains.

        Returns:
            Itself.
        """
        super().train(mode)
        if self.network is not None:
            self.network.eval()
        return self

    def init(self) -> HandState:
        """Return the state without persons."""
        return HandState(self.windows.init(), self._nobody())

    def _nobody(self) -> HandBeliefs:
        return take_rows(self._fresh(1), slice(0, 0))

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
        windows, view = self.look(state.windows, frame, faces, identity, foreground)
        beliefs, hands = self.find(state.beliefs, view, expected)
        return HandState(windows, beliefs), hands

    @torch.no_grad()
    def look(
        self,
        windows: HandWindowState,
        frame: Image,
        faces: Float[Tensor, "N 3"],
        identity: Int[Tensor, " N"],
        foreground: Image | None = None,
    ) -> tuple[HandWindowState, HandView | None]:
        """Return the next windows and what they show in the next frame; None without persons.

        Args:
            windows: of the state from `init`, or from the frame before.
            frame, faces, identity, foreground: see `step`.

        Returns:
            The windows for the next frame, and the `HandView` of this one.

        Raises:
            InputError, ShapeError: see `step`.
        """
        check_frame(frame, faces, identity, foreground)
        if not len(faces):
            return self.windows.init(), None
        return self.windows.look(windows, frame, faces.double(), identity, foreground)

    @torch.no_grad()
    def find(
        self,
        state: HandBeliefs,
        view: HandView | None,
        expected: tuple[Float[Tensor, "N 2 2"], Float[Tensor, "N 2 2 2"]] | None = None,
    ) -> tuple[HandBeliefs, HandMeasurements]:
        """Return the next beliefs and the hands in the next frame, given what its windows show.

        Args:
            state: the beliefs of the state from `init`, or from the frame before.
            view: from `look`. expected: see `step`.

        Returns:
            The next beliefs, and `HandMeasurements`.
        """
        if view is None:
            return self._nobody(), no_hands(torch.zeros(0, 3, dtype=torch.float64))
        state = self._persons(state, view)
        state, means, found = self._evidence(state, view)
        log_likelihood = self.likelihood(means, view.shape) + self.settings.prior * view.log_prior
        if found is not None:
            log_likelihood = self.settings.beside_network * log_likelihood + found.log_prob
            state = state._replace(gone=self._gone(state.gone, found.gone))
        rebirth = self._rebirth(view, expected)
        belief, new = state.cells, state.frames == 0
        if bool(new.any()):
            belief = torch.where(new[:, None, None, None], rebirth, belief)
        belief = self._filter(state, belief, rebirth, log_likelihood, view)
        state, hands = self._measure(state._replace(cells=belief), means[:, 1], view)
        if found is not None and self.elbows:
            expected_elbow = expected_elbows(hands, view.elbow, view.anchors)
            elbows = find_elbows(found, expected_elbow, view.anchors, view.size, self.settings)
            hands = hands._replace(
                elbows=elbows.points, elbow_covariance=elbows.covariance, elbow_seen=elbows.seen
            )
        return state, hands

    def _persons(self, state: HandBeliefs, view: HandView) -> HandBeliefs:
        """Return the state of the persons of this frame, in windows that have followed their faces."""
        if not torch.equal(state.identity, view.identity):
            state = match_states(state, self._fresh(1), view.identity)
        moved = view.moved
        if not bool(moved.any()):
            return state
        cells = state.cells.clone()
        kept = move_maps(cells[moved], view.before[moved], view.anchors[moved]) + 1e-9
        cells[moved] = kept / kept.sum((2, 3), keepdim=True)
        return state._replace(cells=cells)

    def _fresh(self, count: int) -> HandBeliefs:
        """Return the state of new persons."""
        number = torch.zeros(count, dtype=torch.long)
        nowhere = torch.full((count, 2, 2), torch.nan, dtype=torch.float64)
        even = torch.full((count, 2, *CELLS), 1 / math.prod(CELLS), dtype=torch.float32)
        gone = torch.full((count, 2), _UNKNOWN if self.network else 0.0, dtype=torch.float32)
        return HandBeliefs(
            number, self.skin.init(count), self.memory.init(count), even, gone,
            nowhere, torch.zeros_like(nowhere), number.clone(),
        )  # fmt: skip

    def _evidence(
        self, state: HandBeliefs, view: HandView
    ) -> tuple[HandBeliefs, Tensor, HandPlaces | None]:
        """Return the next state, the likelihood's means in every cell, and the network's places."""
        inside = view.inside
        hands = _hands_near(state.cells) * (state.frames > 0)[:, None, None]
        learnt = self.skin.learn(
            state.skin,
            view.bins,
            view.parts,
            interpolate(hands[:, None], scale_factor=float(EVIDENCE))[:, 0],
            inside > 0.5,
        )
        skin = self.skin.find(learnt, view.bins)
        memory, hidden = self.memory.step(state.memory, view.head, view.faces, view.anchors, hands)
        rows, columns = head_part(EVIDENCE)
        skin[:, rows, columns] *= 1 - hidden
        if view.foreground is not None:
            skin = skin * view.foreground
        if float(inside.min()) < 1:
            skin = skin * inside + self.likelihood.unknown * (1 - inside)
        of_cells = halve(skin)[:, None]
        means = self.likelihood.means(of_cells, view.motion)
        found = None
        if self.network is not None:
            maps = torch.cat([of_cells, view.maps], 1)
            found = self.network.find(view.lab, maps, inside, view.near, self.elbows, view.colours)
        return state._replace(skin=learnt, memory=memory), means, found

    def _gone(
        self, before: Float[Tensor, "N 2"], log_odds: Float[Tensor, "N 2"]
    ) -> Float[Tensor, "N 2"]:
        """Return the probability that hands are gone: a chain of two states, and a tempered likelihood."""
        s = self.settings
        predicted = 0.5 + (2 * s.gone_stay - 1) ** self.rate * (before - 0.5)
        odds = torch.logit(predicted) + s.gone_weight * (log_odds + s.gone_bias)
        return torch.sigmoid(odds).clamp(_SUREST, 1 - _SUREST)

    def _rebirth(self, view: HandView, expected: tuple[Tensor, Tensor] | None) -> Tensor:
        """Return the density from which lost hands are reinitialised."""
        born, anchors = view.rebirth, view.anchors
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
        state: HandBeliefs,
        belief: Tensor,
        rebirth: Tensor,
        log_likelihood: Tensor,
        view: HandView,
    ) -> Tensor:
        """Return the beliefs after a frame."""
        s, rate, moves = self.settings, self.rate, view.moves
        speed = (state.speed / (view.anchors[:, 2:, None] * CELL)).float()
        predicted = predict(
            belief, rebirth, speed, view.flow, moves,
            near=s.near / CELL * rate, far=s.far / CELL * rate, near_share=s.near_share,
            flow_share=s.flow, flow_blur=s.flow_blur / CELL, jump=1 - (1 - s.jump) ** rate,
            rest=s.rest / CELL,
        )  # fmt: skip
        best = log_likelihood.amax((2, 3), keepdim=True)
        weight = (moves[:, None, None, None] * (log_likelihood - best)).clamp_min(-30).exp()
        exclusion, crossing, present = s.exclusion, s.crossing, 1 - state.gone
        if self.network is not None:
            exclusion, crossing = s.exclusion_beside_network, s.crossing_beside_network
            predicted = without_jumps(
                predicted, s.jump_to_other, s.jump_reach / CELL, s.jump_radius / CELL, present
            )
        return exclude(
            predicted * weight, exclusion, s.exclusion_radius / CELL,
            crossing, s.crossing_soft / CELL, present,
        )  # fmt: skip

    def _measure(
        self, state: HandBeliefs, skin: Tensor, view: HandView
    ) -> tuple[HandBeliefs, HandMeasurements]:
        """Return the next state and the hands that the beliefs stand for."""
        s, anchors = self.settings, view.anchors
        found = read_out(state.cells, smooth=1.5, within=5.0)
        points = cells_to_pixels(found.place, anchors)
        unit = (anchors[:, 2] * CELL).square()[:, None, None, None]
        floor = (s.covariance_floor / CELL) ** 2 * torch.eye(2, dtype=unit.dtype)
        covariance = (s.covariance_scale * found.covariance + floor) * unit
        there = in_frame(points, view.size)
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


def _hands_near(belief: Tensor) -> Tensor:
    """Return the probability that a cell belongs to a hand [N, r, c]."""
    rows, columns = (_band(n) for n in CELLS)
    return (rows @ belief.sum(1) @ columns).clamp(0, 1)


@cache
@outside_inference()
def _band(size: int) -> Tensor:
    place = torch.arange(size)
    return ((place[:, None] - place).abs() <= _NEAR).float()
