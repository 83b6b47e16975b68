"""Detect foreground, shadow and highlight by brightness and chromaticity against a learnt background."""

from collections.abc import Iterable, Mapping
from enum import IntEnum
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from torchpose.errors import InputError, ShapeError

_NOISE = 3.0  # grey levels: least deviation of a camera's pixel, rounding and codec included
_LEAST_BRIGHTNESS = 0.01  # of the rms of alpha - 1, where a background hardly varies
_DARK = 12.0  # grey levels: a background darker than this has no chromaticity to speak of
_CHUNK = 1 << 22  # values at a time while fitting


class PixelKind(IntEnum):
    """Names the class of a pixel."""

    BACKGROUND = 0
    SHADOW = 1
    HIGHLIGHT = 2
    FOREGROUND = 3


class Distortion(NamedTuple):
    """Holds the distortions of a colour against the background, in units of the background's own.

    Attributes:
        brightness: (alpha - 1) / a [..., H, W]; negative is darker.
        chromaticity: CD / b [..., H, W], not negative.
    """

    brightness: Tensor
    chromaticity: Tensor


class BrightnessBackground(nn.Module):
    """Classifies pixels against a background, where a shadow has its chromaticity and less brightness.

    With the mean E and standard deviation s of a pixel's colour channels c, the brightness distortion
    alpha = sum_c(I_c E_c / s_c^2) / sum_c(E_c^2 / s_c^2) scales the expected colour to be nearest to I.
    The chromaticity distortion is the distance that remains,
    CD = sqrt(sum_c ((I_c - alpha E_c) / s_c)^2). Both are divided by their root mean squares a and b
    over the learnt frames. A pixel is foreground if CD / b exceeds
    `chromaticity` or the pixel is darker than `darkest` times the background, else background if
    |alpha - 1| / a is at most `brightness`, else shadow if it is darker and highlight if brighter.
    Dark grey clothes in front of a grey wall are classified as shadow.

    Args:
        chromaticity, brightness: thresholds, in the units above. darkest: least alpha of a shadow.

    Buffers: mean, std [3, H, W] (grey levels of 0 to 255), brightness_rms, chromaticity_rms [H, W].

    Raises:
        InputError: thresholds out of range.

    Reference:
        T. Horprasert, D. Harwood, L. Davis, "A statistical approach for real-time robust background
        subtraction and shadow detection" (1999), equations 3 to 12. Floors under s, a and b, without
        which one frame could not be learnt from, are an addition.

    >>> empty = torch.full((1, 3, 4, 4), 120, dtype=torch.uint8)
    >>> model = BrightnessBackground().fit(empty)
    >>> frame = empty[0].clone()
    >>> frame[:, 1, 1], frame[:, 2, 2] = 80, torch.tensor([200, 40, 40], dtype=torch.uint8)
    >>> kinds = model(frame)
    >>> PixelKind(int(kinds[1, 1])).name, PixelKind(int(kinds[2, 2])).name, int(kinds[0, 0])
    ('SHADOW', 'FOREGROUND', 0)
    """

    mean: Tensor
    std: Tensor
    brightness_rms: Tensor
    chromaticity_rms: Tensor

    def __init__(
        self, chromaticity: float = 6.0, brightness: float = 4.0, darkest: float = 0.4
    ) -> None:
        super().__init__()
        if not (chromaticity > 0 and brightness > 0 and 0 <= darkest < 1):
            raise InputError(
                "chromaticity and brightness must be positive and darkest in [0, 1), got "
                f"{chromaticity}, {brightness} and {darkest}"
            )
        self.chromaticity, self.brightness, self.darkest = chromaticity, brightness, darkest
        for name in ("mean", "std", "brightness_rms", "chromaticity_rms"):
            self.register_buffer(name, torch.empty(0))
        self.register_load_state_dict_pre_hook(_make_room)

    def fit(self, frames: UInt8[Tensor, "N 3 H W"]) -> "BrightnessBackground":
        """Learn the empty scene from one frame or more; several tens are better.

        Args:
            frames: RGB, without the person.

        Returns:
            Itself.

        Raises:
            ShapeError: not frames of that shape. InputError: no frame.
        """
        if frames.ndim != 4 or frames.shape[1] != 3:
            raise ShapeError(f"frames must be RGB [N, 3, H, W], got {list(frames.shape)}")
        if not len(frames):
            raise InputError("frames must hold at least one frame of the empty scene, got none")
        n, count = len(frames), max(1, _CHUNK // frames[0].numel())
        parts = frames.split(count)
        self.mean = _sum(part.float().sum(0) for part in parts) / n
        squares = _sum((part.float() - self.mean).square().sum(0) for part in parts)
        self.std = (squares / max(n - 1, 1)).sqrt().clamp_min(_NOISE)
        alpha_squares, chroma_squares = torch.zeros(()), torch.zeros(())
        for part in parts:
            alpha, chroma = self._distort(part)
            alpha_squares = alpha_squares + (alpha - 1).square().sum(0)
            chroma_squares = chroma_squares + chroma.square().sum(0)
        # for a background without variation: the rms that noise of `std` alone would cause
        signal = (self.mean / self.std).square().sum(0).sqrt().clamp_min(1e-6)
        floor = (0.5 / signal).clamp_min(_LEAST_BRIGHTNESS)
        self.brightness_rms = (alpha_squares / n).sqrt().maximum(floor)
        self.chromaticity_rms = (chroma_squares / n).sqrt().clamp_min(1.0)
        return self

    def distortion(self, images: UInt8[Tensor, "*batch 3 H W"]) -> Distortion:
        """Return the normalised distortions of images of the learnt size.

        Raises:
            ShapeError: another size. InputError: nothing was learnt.
        """
        self._check(images)
        alpha, chroma = self._distort(images)
        return Distortion((alpha - 1) / self.brightness_rms, chroma / self.chromaticity_rms)

    def forward(self, images: UInt8[Tensor, "*batch 3 H W"]) -> Int[Tensor, "*batch H W"]:
        """Return the `PixelKind` of every pixel.

        Raises:
            ShapeError: another size than learnt. InputError: nothing was learnt.
        """
        brightness, chromaticity = self.distortion(images)
        alpha = 1 + brightness * self.brightness_rms
        dark = self.mean.mean(0) < _DARK
        # where the background is nearly black, its direction in colour space means nothing
        other = (chromaticity > self.chromaticity) | ((alpha < self.darkest) & ~dark)
        kinds = torch.full(brightness.shape, int(PixelKind.BACKGROUND), device=images.device)
        kinds[brightness < -self.brightness] = int(PixelKind.SHADOW)
        kinds[brightness > self.brightness] = int(PixelKind.HIGHLIGHT)
        kinds[(brightness > self.brightness) & dark] = int(PixelKind.FOREGROUND)
        kinds[other] = int(PixelKind.FOREGROUND)
        return kinds

    def _distort(self, images: Tensor) -> tuple[Float[Tensor, "..."], Float[Tensor, "..."]]:
        colours, weight = images.float(), self.std.square().reciprocal()
        against = (self.mean.square() * weight).sum(0).clamp_min(1e-6)
        alpha = (colours * self.mean * weight).sum(-3) / against
        away = (colours - alpha.unsqueeze(-3) * self.mean) / self.std
        return alpha, away.square().sum(-3).sqrt()

    def _check(self, images: Tensor) -> None:
        if not self.mean.numel():
            raise InputError("the background is not known yet: call fit with empty frames first")
        if images.shape[-3:] != self.mean.shape:
            raise ShapeError(
                f"images must have the size that was learnt, {list(self.mean.shape)}, "
                f"got {list(images.shape[-3:])}"
            )


def _sum(parts: Iterable[Tensor]) -> Tensor:
    total: Tensor | None = None
    for part in parts:
        total = part if total is None else total + part
    if total is None:
        raise InputError("frames must hold at least one frame of the empty scene, got none")
    return total


def _make_room(module: nn.Module, state_dict: Mapping[str, Any], prefix: str, *_: object) -> None:
    """Resize the buffers to those that are loaded: their size is that of the learnt images."""
    for name, buffer in module.named_buffers(recurse=False):
        loaded = state_dict.get(prefix + name)
        if isinstance(loaded, Tensor):
            setattr(module, name, buffer.new_empty(loaded.shape))
