"""See in windows about faces what images and faces alone tell of hands, before any belief about these."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchpose._core.images import Image
from torchpose.measure._background import Motion, MotionState
from torchpose.measure._body_window import (
    CELL,
    COLOURS,
    EVIDENCE,
    cell_axes,
    cell_centres,
    cut_colours,
    cut_mask,
    faces_in_evidence,
    faces_in_window,
    follow_faces,
    halve,
    inside_image,
    place_windows,
)
from torchpose.measure._hand_likelihood import HandLikelihood, HandSettings
from torchpose.measure._hand_network import HandNetwork
from torchpose.measure._hand_prior import HandPrior
from torchpose.measure._head import head_part
from torchpose.measure._persons import match_states, take_rows
from torchpose.measure._skin import PersonParts, SkinModel, parts_of_persons

_REACH = -5.2  # log density per B squared above which a hand may be in a place
_FACE = (0.7, 0.9)  # half the width and height of a face with its surroundings, in B


class HandWindowState(NamedTuple):
    """Holds the windows of N persons, the first dimension of every tensor.

    Attributes:
        identity: number of each person. anchors: of the windows (x, y, B), pixels.
        size: B, slowly averaged, pixels. motion: of `Motion`. frames: seen so far.
    """

    identity: Int[Tensor, " N"]
    anchors: Float[Tensor, "N 3"]
    size: Float[Tensor, " N"]
    motion: MotionState
    frames: Int[Tensor, " N"]


class HandView(NamedTuple):
    """Holds what the windows of N persons show in a frame; maps have two pixels for a cell.

    Attributes:
        size: of the frame (H, W). identity: number of each person.
        anchors: of the windows in this frame, and before: in the last one, (x, y, B), pixels.
        moved: whether the two differ. faces: (x, y, B), pixels, B steady.
        near: the same in B from the anchors.
        lab: bytes. head: `head_part` of the window, bytes, four pixels for a cell.
        gain: that dark windows were multiplied by before. bins: of the skin's histograms.
        inside: share of each pixel in the image. foreground: share; None if not known.
        maps: difference from the last frame and from the median, 0 outside of the image [N, 2, 88, 96].
        flow: of `Motion`.
        colours: features of the network, from colours alone; None without a network.
        motion: means of both kinds over hands [N, 2, 88, 96]. moves: amount of motion, 0 to 1 [N].
        parts: of the persons, for the colours of skin.
        log_prior: density of both hands given the face, per B squared [N, 2, 88, 96].
        rebirth: where lost hands are looked for, low in front of the face [N, 2, 88, 96].
        elbow: expected with a hand in each cell, in B from the anchor [N, 2, 2, 88, 96].
        shape: places whose skin tells a hand with this elbow [N, P, 2, 88, 96, 2].
    """

    size: tuple[int, int]
    identity: Int[Tensor, " N"]
    anchors: Float[Tensor, "N 3"]
    before: Float[Tensor, "N 3"]
    moved: Bool[Tensor, " N"]
    faces: Float[Tensor, "N 3"]
    near: Float[Tensor, "N 3"]
    lab: UInt8[Tensor, "N 3 h w"]
    head: UInt8[Tensor, "N 3 p q"]
    gain: Float[Tensor, " N"]
    bins: Int[Tensor, "N h w"]
    inside: Float[Tensor, "N h w"]
    foreground: Float[Tensor, "N h w"] | None
    maps: Float[Tensor, "N 2 r c"]
    flow: Float[Tensor, "N r c 2"]
    colours: Float[Tensor, "N F a b"] | None
    motion: Float[Tensor, "N 2 r c"]
    moves: Float[Tensor, " N"]
    parts: PersonParts
    log_prior: Float[Tensor, "N 2 r c"]
    rebirth: Float[Tensor, "N 2 r c"]
    elbow: Float[Tensor, "N 2 2 r c"]
    shape: Float[Tensor, "N P 2 r c 2"]


@dataclass(frozen=True)
class HandWindows:
    """Follows faces with windows, and sees in them what no belief about hands changes.

    It can therefore run ahead of the beliefs, in another thread.

    Attributes:
        settings: constants. rate: frames at 30 per second that pass in one step.
        prior, skin, motion, likelihood, network: modules of the `HandTracker`.
    """

    settings: HandSettings
    rate: float
    prior: HandPrior
    skin: SkinModel
    motion: Motion
    likelihood: HandLikelihood
    network: HandNetwork | None

    def init(self) -> HandWindowState:
        """Return the state without persons."""
        return take_rows(self._fresh(torch.zeros(1, 3)), slice(0, 0))

    def look(
        self,
        state: HandWindowState,
        frame: Image,
        faces: Float[Tensor, "N 3"],
        identity: Int[Tensor, " N"],
        foreground: Image | None = None,
    ) -> tuple[HandWindowState, HandView]:
        """Return the next state and what the windows show in the next frame, of one person at least.

        Args:
            state: from `init` or the frame before; its persons are matched by number.
            frame: RGB [H, W, 3]. faces: (x, y, B), pixels. identity: number of each face.
            foreground: [H, W], 255 where the image is not background.
        """
        state = self._persons(state, faces, identity)
        state, faces = self._steady(state, faces)
        s, before, motion = self.settings, state.anchors, state.motion
        anchors, moved = follow_faces(before, faces, s.stray, s.rescale)
        if bool(moved.any()):
            motion = self.motion.move(motion, before, anchors, moved)
        lab, smooth, head, gain = cut_colours(frame, anchors, head_part(COLOURS))
        planes = lab.contiguous()
        motion, moving, unusual, flow = self.motion.step(motion, smooth, planes[:, 0])
        inside = inside_image(anchors, frame.shape[1], frame.shape[0], EVIDENCE)
        near = faces_in_window(faces, anchors)
        colours = None if self.network is None else self.network.see_colours(lab, inside, near)
        mask = None if foreground is None else cut_mask(foreground, anchors)
        maps = torch.stack([moving, unusual], 1)
        if float(inside.min()) < 1:
            maps.mul_(inside[:, None])
        maps = halve(maps)
        over_hands = self.likelihood.over_hands(maps)
        log_prior, elbow = self._prior(near)
        view = HandView(
            (frame.shape[0], frame.shape[1]), identity, anchors, before, moved, faces, near,
            lab, head, gain, self.skin.byte_bins(planes), inside, mask, maps, flow, colours, over_hands,
            self._moves(over_hands[:, 0], log_prior),
            parts_of_persons(faces_in_evidence(faces, anchors), lab.shape[2:]),
            log_prior, self._rebirth(log_prior, near), elbow, self.likelihood.shape_places(elbow),
        )  # fmt: skip
        state = state._replace(anchors=anchors, motion=motion, frames=state.frames + 1)
        return state, view

    def _fresh(self, anchors: Tensor) -> HandWindowState:
        """Return the state of new persons."""
        number = torch.zeros(len(anchors), dtype=torch.long)
        anchors = anchors.double()
        motion = self.motion.init(len(anchors))
        return HandWindowState(number, anchors, anchors[:, 2], motion, number.clone())

    def _persons(self, state: HandWindowState, faces: Tensor, identity: Tensor) -> HandWindowState:
        """Return the state of the persons of this frame."""
        if torch.equal(state.identity, identity):
            return state
        new = ~torch.isin(identity, state.identity)
        anchors = place_windows(faces)
        state = match_states(state, self._fresh(anchors[:1]), identity)
        return state._replace(anchors=torch.where(new[:, None], anchors, state.anchors))

    def _steady(self, state: HandWindowState, faces: Tensor) -> tuple[HandWindowState, Tensor]:
        """Return the faces with averaged sizes: a hand in front of a face changes its bounding box only."""
        follow = torch.clamp(1 / (state.frames + 1.0), min=self.settings.face_follow * self.rate)
        off = (faces[:, 2] / state.size).log().abs() > math.log(self.settings.face_change)
        follow = torch.where(off, 1.0, follow.clamp(max=1.0))
        size = state.size.lerp(faces[:, 2], follow.to(faces))
        return state._replace(size=size), torch.cat([faces[:, :2], size[:, None]], 1)

    def _prior(self, near: Tensor) -> tuple[Tensor, Tensor]:
        """Return log density and expected elbow of `HandView`."""
        at, size = near[:, None, None, :2], near[:, 2, None, None, None]
        log_density, elbow = self.prior((cell_centres() - at) / size)
        elbow = elbow.movedim(2, 0) * size[:, None] + at.permute(0, 3, 1, 2)[:, None]
        return log_density.movedim(1, 0), elbow

    def _moves(self, moving: Tensor, log_prior: Tensor) -> Tensor:
        """Return the amount of motion where hands may be, 0 to 1; a frame without any counts a little."""
        s = self.settings
        reach = log_prior.amax(1) > _REACH
        amount = (moving * reach).sum((1, 2)) * CELL**2 / s.still_motion
        return s.still + (1 - s.still) * amount.clamp(0, 1)

    def _rebirth(self, log_prior: Tensor, near: Tensor) -> Tensor:
        """Return `HandView.rebirth`."""
        cost = self.settings.face_rebirth * _before_face(near)[:, None]
        return torch.softmax((log_prior - cost).flatten(2), 2).view_as(log_prior)


def _before_face(at: Tensor) -> Tensor:
    """Return a map that is one on the face, (x, y, B) from the anchor, and zero away from it [N, r, c]."""
    x, y = cell_axes()
    across = ((x - at[:, :1]) / (at[:, 2:] * _FACE[0])).square()
    down = ((y - at[:, 1:2]) / (at[:, 2:] * _FACE[1])).square()
    return torch.sigmoid(6 * (1 - (across[:, None] + down[:, :, None])))
