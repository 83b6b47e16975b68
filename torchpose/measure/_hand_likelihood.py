"""Compute the likelihood map of a hand in a person's window; hold its constants and hand measurements."""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose._core.checks import check_finite, check_rgb, check_shape
from torchpose._core.images import Image
from torchpose._core.module_state import outside_inference
from torchpose.errors import InputError
from torchpose.measure._body_window import CELL, CELLS, cell_centres
from torchpose.measure._face_detector import check_faces

# turns (y, x) into the vector across
_ACROSS = torch.tensor([-1.0, 1.0], dtype=torch.float32)[:, None, None]


class HandLikelihood(nn.Module):
    """Computes the log-likelihood of a hand at every cell from skin, motion, and the shape of a hand.

        l(x) = a D(x) + c S(x) + m M(x) + u U(x)
             - b S(x - 0.9 e) + t S(x + 0.65 e) - s (S(x - 0.55 n) + S(x + 0.55 n))

    D, M and U are the means over a hand of skin, of the difference from the last frame and of that from
    the median; S is the mean of skin over a palm. e is the unit vector towards the elbow that the pose
    prior expects, n the one across. A hand has the forearm on one side and no skin beyond its fingers;
    a point on a bare forearm has skin on both sides. Outside of the image skin has a fixed
    probability, which favours neither a hand at the border nor its absence.

    Args:
        disc: a. core: c. motion: m. unusual: u. beyond: b. towards: t. beside: s.
        beyond_at, towards_at, beside_at: distances in B.
        hand, palm: their widths, in B; a hand counts less towards its edges.
        unknown: probability of skin where nothing is known.
    """

    def __init__(
        self,
        disc: float = 5.0,
        core: float = 4.0,
        motion: float = 4.0,
        unusual: float = 0.8,
        beyond: float = 3.0,
        towards: float = 0.75,
        beside: float = 1.2,
        beyond_at: float = 0.9,
        towards_at: float = 0.65,
        beside_at: float = 0.55,
        hand: float = 0.8,
        palm: float = 0.35,
        unknown: float = 0.15,
    ) -> None:
        super().__init__()
        self.unknown = unknown
        self.register_buffer(
            "cues", torch.tensor([core, disc, motion, unusual], dtype=torch.float32)
        )
        weights = [-beyond, towards, -beside, -beside]
        offsets = [[-beyond_at, 0.0], [towards_at, 0.0], [0.0, -beside_at], [0.0, beside_at]]
        used = [i for i, weight in enumerate(weights) if weight]
        self.register_buffer(
            "shape_weights", torch.tensor([weights[i] for i in used], dtype=torch.float32)
        )
        self.register_buffer(
            "shape_offsets",
            torch.tensor([offsets[i] for i in used], dtype=torch.float32).reshape(-1, 2),
        )
        for name, count in (("rows", CELLS[0]), ("columns", CELLS[1])):
            self.register_buffer(f"palm_{name}", _palm_matrix(count, palm))
            self.register_buffer(f"hand_{name}", _hand_matrix(count, hand))

    cues: Tensor
    shape_weights: Tensor
    shape_offsets: Tensor
    palm_rows: Tensor
    palm_columns: Tensor
    hand_rows: Tensor
    hand_columns: Tensor

    def means(
        self, skin: Float[Tensor, "N 1 r c"], motion: Float[Tensor, "N 2 r c"]
    ) -> Float[Tensor, "N 4 r c"]:
        """Return means about the centre of every cell: skin over a palm, then all maps over a hand.

        Args:
            skin: its mean over every cell; the border is repeated beyond the window.
            motion: `over_hands` of the differences from the last frame and from the median.
        """
        palm = self.palm_rows @ skin @ self.palm_columns.T
        return torch.cat([palm, self.over_hands(skin), motion], 1)

    def over_hands(self, maps: Float[Tensor, "N C r c"]) -> Float[Tensor, "N C r c"]:
        """Return means of maps of the cells over a hand about the centre of every cell; see `means`."""
        return self.hand_rows @ maps @ self.hand_columns.T

    def forward(
        self, means: Float[Tensor, "N 4 r c"], places: Float[Tensor, "N P 2 r c 2"]
    ) -> Float[Tensor, "N 2 r c"]:
        """Return the log-likelihood of the left and the right hand, up to a constant.

        Args:
            means: see `means`. places: see `shape_places`.
        """
        check_shape("means", means, ["N", 4, *CELLS])
        common = torch.tensordot(self.cues, means.movedim(1, 0), 1)[:, None]
        if not len(self.shape_weights):
            return common.expand(-1, 2, -1, -1)
        found = nn.functional.grid_sample(
            means[:, :1] - self.unknown, places.flatten(2, 4), align_corners=False
        )
        total = self.unknown * self.shape_weights.sum()
        shape = self.shape_weights @ found.view(*places.shape[:2], -1) + total
        return common + shape.view(len(places), 2, *CELLS)

    def shape_places(self, elbow: Float[Tensor, "N 2 2 r c"]) -> Float[Tensor, "N P 2 r c 2"]:
        """Return the places about every cell and hand whose skin tells the shape, in halves of the window.

        Args:
            elbow: (x, y) of the expected elbow of each arm, in B from the anchor.
        """
        places, start, half = _grid()
        to_elbow = elbow - places
        along = to_elbow / (to_elbow.square().sum(2, keepdim=True).sqrt_() + 1e-3)
        across = along.flip(2) * _ACROSS.to(along)
        along, across = along / half, across / half
        offsets = self.shape_offsets.tolist()
        grid = along.new_empty(len(along), len(offsets), 2, *CELLS, 2)
        for point, (forward, aside) in enumerate(offsets):
            place = start
            if forward:
                place = torch.add(place, along, alpha=forward)
            if aside:
                place = torch.add(place, across, alpha=aside)
            grid[:, point] = place.movedim(2, -1)
        return grid


@cache
@outside_inference()
def _grid() -> tuple[Tensor, Tensor, Tensor]:
    """Return the places of the cells [2, r, c], in B and in halves of the window from its middle, and these.

    The first dimension is x and y: operations on pairs in the last one are slow.
    """
    places = cell_centres()
    half = (places[-1, -1] - places[0, 0] + CELL) / 2
    start = (places - (places[-1, -1] + places[0, 0]) / 2) / half
    planes = places.movedim(-1, 0).contiguous(), start.movedim(-1, 0).contiguous()
    return *planes, half[:, None, None]


def _palm_matrix(cells: int, palm: float) -> Tensor:
    """Return the matrix of means over `palm` about the middle of each cell."""
    centre = (torch.arange(cells, dtype=torch.float32)[:, None] + 0.5) * CELL
    edge = torch.arange(cells + 1, dtype=torch.float32) * CELL
    edge[0], edge[-1] = -palm, edge[-1] + palm  # the border counts for what is beyond it
    part = edge[None].clamp(min=centre - palm / 2, max=centre + palm / 2).diff(dim=1)
    return part / part.sum(1, keepdim=True)


def _hand_matrix(cells: int, hand: float) -> Tensor:
    """Return the matrix of means over a hand, whose weights fall off over its outer half."""
    return sum(  # type: ignore[return-value]
        _palm_matrix(cells, hand * (0.5 + (i + 0.5) / n)) / n for n in (8,) for i in range(n)
    )


@dataclass(frozen=True)
class HandSettings:
    """Holds the constants of `HandTracker`; lengths in face heights B, rates at 30 frames per second.

    Attributes:
        skin_slope, skin_bias, skin_decay, skin_floor, clothes_share: see `SkinModel`.
        unknown_skin: probability of skin where the image has ended.
        face_memory: whether a change of the face reveals a hand in front of it; without, head and neck
            are never skin.
        face_alignment, face_deviations, face_floor, face_median, face_scale: see `FaceMemory`.
        disc, core, motion, unusual, beyond, towards, beside: weights of the cues, see `HandLikelihood`.
        prior: weight of the log density of a hand given the face.
        jump: share of belief that is reinitialised from the prior in each frame.
        face_rebirth: cost of reinitialisation in front of the face, in nats.
        expected_share: of the reinitialisation about the expected hands, where these are given.
        near, far, near_share: the two widths of diffusion, and the share of the first.
        flow, flow_blur: share of belief that optical flow carries, and its blur.
        rest: diffusion where nothing moves.
        velocity: share of the last displacement that continues.
        exclusion, exclusion_radius: cost of both hands at one place, in nats, and how far it reaches.
        crossing, crossing_soft: cost of hands on each other's side, in nats, and its softness.
        still: weight of a frame without motion, whose likelihood depends on that of the frame before.
        still_motion: moving area, in B squared, from which a frame counts fully.
        covariance_scale, covariance_floor: the reported covariance is the belief's times the scale,
            plus the floor (a standard deviation).
        least_mass, least_skin: below these a hand is not `seen`.
        elbow_scale, elbow_floor: the covariance of elbows is the network's times the scale, plus the floor
            (a standard deviation).
        elbow_bias: added to a network's log-odds that an elbow is not visible.
        elbow_reach: scale of the density of an elbow about its expected place, given the hand.
        beside_network: weight of all other cues beside a network's.
        exclusion_beside_network, crossing_beside_network: take the places of `exclusion` and `crossing`
            beside a network, which knows hands that are joined and tells left from right itself.
        jump_to_other, jump_reach, jump_radius: cost beside a network of a jump of one hand to the other, in
            nats, how far a hand moves without it, and how far from the other one it counts.
        gone_bias: added to a network's log-odds that a hand is gone: those of strangers look less like hands.
        gone_weight: share of a frame's log-odds that a hand is gone that counts; frames are alike.
        gone_stay: probability that it is still gone, or still there, in the next frame.
        most_gone: from that probability on a hand is not `seen`.
        stray, rescale: see `follow_faces`.
        face_follow: weight of a face's new size in the average; face_change: ratio of sizes from
            which the new size replaces the average.
    """

    skin_slope: float = 1.5
    skin_bias: float = 0.8
    skin_decay: float = 0.95
    skin_floor: float = 2e-4
    clothes_share: float = 0.5
    unknown_skin: float = 0.15
    face_memory: bool = True
    face_alignment: bool = True
    face_deviations: float = 1.5
    face_floor: float = 2.0
    face_median: float = 0.1
    face_scale: float = 4.0
    disc: float = 5.0
    core: float = 4.0
    motion: float = 4.0
    unusual: float = 0.8
    beyond: float = 3.0
    towards: float = 0.75
    beside: float = 1.2
    prior: float = 1.0
    jump: float = 0.015
    face_rebirth: float = 6.0
    expected_share: float = 0.5
    near: float = 0.06
    far: float = 0.25
    near_share: float = 0.7
    flow: float = 0.5
    flow_blur: float = 0.06
    rest: float = 0.035
    velocity: float = 0.8
    exclusion: float = 2.5
    exclusion_radius: float = 0.34
    crossing: float = 2.8
    crossing_soft: float = 0.15
    still: float = 0.12
    still_motion: float = 0.8
    covariance_scale: float = 2.0
    covariance_floor: float = 0.05
    least_mass: float = 0.3
    least_skin: float = 0.15
    elbow_scale: float = 2.0
    elbow_floor: float = 0.2
    elbow_bias: float = -2.0
    elbow_reach: float = 0.6
    beside_network: float = 0.5
    exclusion_beside_network: float = 0.8
    crossing_beside_network: float = 0.7
    jump_to_other: float = 5.0
    jump_reach: float = 1.2
    jump_radius: float = 0.5
    gone_bias: float = -2.0
    gone_weight: float = 0.5
    gone_stay: float = 0.97
    most_gone: float = 0.5
    stray: float = 0.5
    rescale: float = 1.15
    face_follow: float = 0.05
    face_change: float = 1.3


class HandMeasurements(NamedTuple):
    """Holds the hands of N persons: left, right (the person's own), in pixels of the frame.

    Attributes:
        points: centres of the hands (x, y); NaN where unknown.
        covariance: of the points, pixels squared.
        mass: probability that the hand is there.
        seen: False where a hand is lost, to be taken as missing.
        elbows: the elbows, by a tracker with a network. elbow_covariance, elbow_seen: of these.
        absent: probability that a hand cannot be seen, hidden or outside of the image, by a tracker with a
            network; else NaN.
    """

    points: Float[Tensor, "N 2 2"]
    covariance: Float[Tensor, "N 2 2 2"]
    mass: Float[Tensor, "N 2"]
    seen: Bool[Tensor, "N 2"]
    elbows: Float[Tensor, "N 2 2"]
    elbow_covariance: Float[Tensor, "N 2 2 2"]
    elbow_seen: Bool[Tensor, "N 2"]
    absent: Float[Tensor, "N 2"]


def without_elbows(
    points: Float[Tensor, "N 2 2"],
    covariance: Float[Tensor, "N 2 2 2"],
    mass: Float[Tensor, "N 2"],
    seen: Bool[Tensor, "N 2"],
    absent: Float[Tensor, "N 2"] | None = None,
) -> HandMeasurements:
    """Return the measurements of hands without elbows, which are NaN and not seen."""
    return HandMeasurements(
        points, covariance, mass, seen,
        torch.full_like(points, torch.nan), torch.zeros_like(covariance), torch.zeros_like(seen),
        torch.full_like(points[..., 0], torch.nan) if absent is None else absent,
    )  # fmt: skip


def no_hands(faces: Float[Tensor, "0 3"]) -> HandMeasurements:
    """Return the measurements of a frame without persons, in the precision of `faces`."""
    points = faces.new_zeros(0, 2, 2)
    mass = points[..., 0]
    return without_elbows(points, faces.new_zeros(0, 2, 2, 2), mass, mass > 0)


def check_frame(
    frame: Image, faces: Float[Tensor, "N 3"], identity: Int[Tensor, " N"], foreground: Image | None
) -> None:
    """Raise unless these are a frame, faces with a size, their numbers, and a mask of the frame.

    Raises:
        ShapeError, InputError: see above.
    """
    check_rgb("frame", frame)
    check_finite("faces", faces, hint="leave out persons without a face")
    check_faces(faces)
    check_shape("identity", identity, [len(faces)])
    if foreground is not None and (
        foreground.shape != frame.shape[:2] or foreground.dtype != np.uint8
    ):
        raise InputError(
            f"foreground must be [H, W] of uint8 like the frame, {list(frame.shape[:2])}, got "
            f"{list(foreground.shape)} of {foreground.dtype}"
        )
