"""Tell from a person's window where each hand is, or that it is not to be seen, by a small network."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate

from torchpose._core.module_state import derived, outside_inference
from torchpose._core.network_file import FittedNetwork
from torchpose._core.tensor_file import FileKind
from torchpose.measure._body_window import CELLS, EVIDENCE, cell_centres, halve, part_of_window
from torchpose.measure._hand_layers import Layer, UpwardLayer, for_inference

COARSE = (CELLS[0] // 2, CELLS[1] // 2)
"""Rows and columns of the network's own cells, twice as wide as those of the window."""

_SHIPPED = Path(__file__).resolve().parents[1] / "weights" / "hands" / "hands.safetensors"
_FACE = (0.35, 0.4)  # half the width and height, in B, of the part of a face that tells its colour
_SPREAD = (40.0, 12.0, 12.0)  # of L, a and b, by which differences from the face are divided
_MOST = 4.0
_FAR = 0.3  # by which places, in B from the face, are multiplied
_MAPS, _COLOURS = 4, 3  # inputs: skin, two kinds of motion, image; Lab
_PLACES = 3  # inputs: x, y, near the face
_WIDTHS = (12, 20, 8, 24, 40, 56)


@dataclass(frozen=True)
class HandNetworkInfo:
    """Holds facts about the fit of a `HandNetwork`.

    Attributes:
        name: of the network. clips, persons: that it was fitted to. licence: of the clips and parameters.
        command: that made it.
    """

    name: str = ""
    clips: tuple[str, ...] = ()
    persons: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""

    def __post_init__(self) -> None:
        for name in ("clips", "persons"):
            object.__setattr__(self, name, tuple(getattr(self, name)))


_KIND = FileKind("torchpose-hands", 4, HandNetworkInfo)


class HandPlaces(NamedTuple):
    """Holds the output of a network about both hands and both elbows of N persons.

    Attributes:
        log_prob: log-probability of each cell, given that the hand is visible [N, 2, 88, 96].
        gone: log-odds that the hand is not visible [N, 2].
        elbows, elbows_gone: the same for the elbows; of no joints where these were not asked for.
    """

    log_prob: Float[Tensor, "N 2 h w"]
    gone: Float[Tensor, "N 2"]
    elbows: Float[Tensor, "N E h w"]
    elbows_gone: Float[Tensor, "N E"]


class HandNetwork(FittedNetwork):
    """Computes the probability of each hand in every cell of a window, and that it is not to be seen.

        q(x or gone | window) = softmax(logits),   x over 44 x 48 cells of 0.2 B

    A convolutional network of three scales sees the window's colours relative to those of the face (40 of L,
    12 of a and b are one), the maps of skin and motion, where the image ends, and each cell's place
    relative to the face, in B. The logit of a hand that is not to be seen is a constant: a hand is there
    if some cell looks enough like it, whoever the person is. 0.17 million parameters.

    Args:
        info: facts about the fit.
    """

    _kind, _words = _KIND, "a network of hands"

    def __init__(self, info: HandNetworkInfo | None = None) -> None:
        super().__init__(info)
        stem, fine, side, high, middle, low = _WIDTHS
        self.colours = nn.Sequential(Layer(_COLOURS, stem, 5, 2), Layer(stem, fine, 3, 2))
        self.maps = Layer(_MAPS, side)
        self.high = nn.Sequential(Layer(fine + side + _PLACES, high), Layer(high, high))
        self.middle = nn.Sequential(Layer(high, middle, 3, 2), Layer(middle, middle))
        self.low = nn.Sequential(
            Layer(middle, low, 3, 2), nn.Dropout2d(0.1), Layer(low, low), Layer(low, low, 3, 1, 2)
        )
        self.to_middle = UpwardLayer(low, middle, middle)
        self.to_high = UpwardLayer(middle, high, high)
        self.places = nn.Conv2d(high, 2, 1)
        self.gone = nn.Parameter(torch.zeros(2))
        self.elbows = nn.Sequential(Layer(2 * high, high, 1), nn.Conv2d(high, 2, 1))
        self.elbows_gone = nn.Parameter(torch.zeros(2))

    def forward(
        self,
        colours: Float[Tensor, "N 3 h w"],
        maps: Float[Tensor, "N 4 r c"],
        faces: Float[Tensor, "N 3"],
        elbows: bool = True,
    ) -> Float[Tensor, "N J cells"]:
        """Return the logits of 44 x 48 cells, row by row, and of a joint that is not visible.

        Both hands come first, then both elbows.

        Args:
            colours: of `relative_colours`, two pixels for a cell. maps: skin, difference from the last frame
                and from the median, and the share inside the image, half a cell for each [N, 4, 44, 48].
            faces: (x, y, size) in B from the anchors. elbows: whether to look for these.
        """
        return self.logits(self.features_of_colours(colours, maps[:, 3:]), maps, faces, elbows)

    def logits(
        self,
        seen: Float[Tensor, "N F r c"],
        maps: Float[Tensor, "N 4 r c"],
        faces: Float[Tensor, "N 3"],
        elbows: bool = True,
    ) -> Float[Tensor, "N J cells"]:
        """Return the same logits from the `features_of_colours`."""
        features = self.features(seen, maps, faces)
        if not elbows:
            return self.logits_of_hands(features)
        return torch.cat([self.logits_of_hands(features), self.logits_of_elbows(features)], 1)

    def features_of_colours(
        self, colours: Float[Tensor, "N 3 h w"], inside: Float[Tensor, "N 1 r c"]
    ) -> Float[Tensor, "N F r c"]:
        """Return the features of every coarse cell that come from the colours alone.

        Args:
            colours: of `relative_colours`. inside: the share of each coarse cell in the image.
        """
        return self.colours(_within(_Inside.of(inside), colours))  # type: ignore[no-any-return]

    def features(
        self,
        seen: Float[Tensor, "N F r c"],
        maps: Float[Tensor, "N 4 r c"],
        faces: Float[Tensor, "N 3"],
    ) -> Float[Tensor, "N C r c"]:
        """Return the features of every coarse cell: of its surroundings first, then of the cell itself.

        Args:
            seen: the `features_of_colours`. maps, faces: see `forward`.
        """
        high = self.high(torch.cat([seen, self.maps(maps), _where(faces)], 1))
        middle = self.middle(high)
        low = self.low(middle)
        up = self.to_high(self.to_middle(low, middle), high)
        return torch.cat([up, high], 1)

    def logits_of_hands(self, features: Float[Tensor, "N C r c"]) -> Float[Tensor, "N 2 cells"]:
        """Return the logits of both hands."""
        return _with_gone(self.places(features[:, : _WIDTHS[3]]), self.gone)

    def logits_of_elbows(self, features: Float[Tensor, "N C r c"]) -> Float[Tensor, "N 2 cells"]:
        """Return the logits of both elbows."""
        return _with_gone(self.elbows(features), self.elbows_gone)

    def see_colours(
        self,
        lab: UInt8[Tensor, "N 3 h w"],
        inside: Float[Tensor, "N h w"],
        faces: Float[Tensor, "N 3"],
    ) -> Float[Tensor, "N F r c"]:
        """Return the features that come from the colours of windows alone; see `find`."""
        colours = _within(self._inside(inside), relative_colours(lab, faces))
        return for_inference(self).colours(colours)

    def find(
        self,
        lab: UInt8[Tensor, "N 3 h w"],
        maps: Float[Tensor, "N 3 y x"],
        inside: Float[Tensor, "N h w"],
        faces: Float[Tensor, "N 3"],
        elbows: bool = True,
        seen: Float[Tensor, "N F r c"] | None = None,
    ) -> HandPlaces:
        """Return the places of the hands in windows of persons.

        Args:
            lab: bytes, two pixels for a cell [N, 3, 176, 192]. maps: skin, difference from the last frame and
                from the median, of the cells [N, 3, 88, 96]. inside: share of each pixel in the image.
            faces: (x, y, size) in B from the anchors. elbows: whether to look for these.
            seen: of `see_colours`, if known.
        """
        if seen is None:
            seen = self.see_colours(lab, inside, faces)
        every = torch.cat([halve(maps), self._inside(inside).share], 1)
        logits = for_inference(self).logits(seen, every, faces, elbows)
        places, gone = logits[..., :-1], logits[..., -1]
        total = torch.logsumexp(places, -1, keepdim=True)
        here = (places - (total + math.log(4))).unflatten(-1, COARSE)  # four cells share one
        fine = interpolate(here, size=CELLS, mode="bilinear", align_corners=False)
        gone = gone - total[..., 0]
        return HandPlaces(fine[:, :2], gone[:, :2], fine[:, 2:], gone[:, 2:])

    def _inside(self, inside: Float[Tensor, "N h w"]) -> _Inside:
        """Return what the network needs of where the image is; kept, since windows mostly stay in place."""
        return derived(self, "inside", (inside,), lambda: _Inside.of(halve(halve(inside))[:, None]))


class _Inside(NamedTuple):
    """Holds where the image is, for windows of N persons.

    Attributes:
        share: of each coarse cell in the image. kept: one where colours count, two pixels for a cell, and
            beyond: what stands for them elsewhere; None if all count.
    """

    share: Float[Tensor, "N 1 r c"]
    kept: Float[Tensor, "N 3 h w"] | None
    beyond: Float[Tensor, "N 3 h w"] | None

    @classmethod
    def of(cls, share: Float[Tensor, "N 1 r c"]) -> _Inside:
        there = share > 0.5
        if bool(there.all()):
            return cls(share, None, None)
        kept = interpolate(there.to(share), scale_factor=4.0).expand(-1, _COLOURS, -1, -1)
        kept = kept.contiguous(memory_format=torch.channels_last)
        return cls(share, kept, (kept - 1) * _MOST)


def _within(image: _Inside, colours: Float[Tensor, "N 3 h w"]) -> Float[Tensor, "N 3 h w"]:
    """Return colours with the border of the image going on beyond it."""
    if image.kept is None or image.beyond is None:
        return colours
    # filling by a mask takes twenty times as long
    return torch.addcmul(image.beyond, colours, image.kept)


def _with_gone(
    places: Float[Tensor, "N 2 r c"], gone: Float[Tensor, " 2"]
) -> Float[Tensor, "N 2 cells"]:
    """Return the logits of all cells, and of a joint that is not visible."""
    return torch.cat([places.flatten(2), gone[:, None].expand(len(places), -1, -1)], 2)


def relative_colours(
    lab: UInt8[Tensor, "N 3 h w"], faces: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3 h w"]:
    """Return the colours of windows relative to the mean colour of their faces.

    Args:
        lab: bytes, two pixels for a cell. faces: (x, y, size) in B from the anchors.
    """
    import cv2

    mean = _mean_of_faces(lab, faces)[:, None]
    byte = torch.arange(256, dtype=torch.float32)[:, None]
    tables = ((byte - mean) / mean.new_tensor(_SPREAD)).clamp_(-_MOST, _MOST).numpy()
    pixels = lab.permute(0, 2, 3, 1).numpy()
    colours = np.empty(pixels.shape, np.float32)
    for own, table, relative in zip(pixels, tables, colours, strict=True):
        cv2.LUT(own, table[None], dst=relative)
    return torch.from_numpy(colours).permute(0, 3, 1, 2)


def _mean_of_faces(
    lab: UInt8[Tensor, "N 3 h w"], faces: Float[Tensor, "N 3"]
) -> Float[Tensor, "N 3"]:
    """Return the mean colour of each face; zero without one in its window."""
    half = faces[:, 2:] * faces.new_tensor(_FACE)
    rows, columns = part_of_window(faces[:, :2] - half, faces[:, :2] + half, EVIDENCE)
    centres = cell_centres(EVIDENCE)[rows, columns].to(faces)
    away = (centres - faces[:, None, None, :2]) / half[:, None, None]
    face = (away.square().sum(-1) < 1).float()[:, None]
    total = (lab[:, :, rows, columns].float() * face).sum((2, 3))
    return total / face.sum((2, 3)).clamp_min(1.0)


def _where(faces: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 r c"]:
    """Return the place of every coarse cell relative to the face, and how near to it that is."""
    away = (_coarse_centres() - faces[:, None, None, :2]) / faces[:, None, None, 2:]
    near = (-away.square().sum(-1, keepdim=True)).exp()
    return torch.cat([_FAR * away, near], -1).movedim(-1, 1)


@cache
@outside_inference()
def _coarse_centres() -> Float[Tensor, "r c 2"]:
    """Return the places (x, y) of the coarse cells, in B from the anchor."""
    return avg_pool2d(cell_centres().movedim(-1, 0), 2).movedim(0, -1).contiguous()


@outside_inference()
def shipped_hand_network() -> HandNetwork:
    """Return the network that comes with the package, a copy of its own for each caller."""
    return deepcopy(_read_once())


@cache
def _read_once() -> HandNetwork:
    return HandNetwork.load(_SHIPPED)
