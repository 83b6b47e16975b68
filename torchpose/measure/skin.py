"""Skin in colour images, from a histogram of the face (Burke & Lasenby, section 5.2).

The paper back-projects the colours of a detected face. Clothes and walls may have colours of skin, so
the face is compared with what is not skin: the clothes below it, and what is far from the person.
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchpose.errors import InputError, check_shape

__all__ = ["SkinModel", "SkinState", "rgb_to_lab"]

BINS = (8, 32, 32)  # of L, a and b
_LOWEST, _WIDTH = (0.0, -24.0, -24.0), (12.5, 2.0, 3.0)
_KERNELS = ((0.1, 0.8, 0.1), (0.05, 0.24, 0.42, 0.24, 0.05), (0.05, 0.24, 0.42, 0.24, 0.05))
# Parts of the image, in sizes of the face from its centre.
_FACE = (0.25, -0.2, 0.35)  # half the width, top, bottom
_CLOTHES = (0.75, 1.15)  # half the width, top
_FAR = (2.6, -0.9)  # beyond this to either side, or above this
_LEAST_FACE, _LEAST_PIXELS = 0.3, 50.0  # share of the patch, and pixels of the others
_HAND_IN_FACE, _HAND_ELSEWHERE, _HAIR = 0.3, 0.25, -0.5
_LARGEST_RATIO = 4.0


class SkinState(NamedTuple):
    """Colours of B persons, exponentially averaged; each sums to one.

    Attributes:
        face, clothes, far: [B, 8, 32, 32] over L, a and b. frames: seen so far.
    """

    face: Float[Tensor, "B 8 32 32"]
    clothes: Float[Tensor, "B 8 32 32"]
    far: Float[Tensor, "B 8 32 32"]
    frames: int


def rgb_to_lab(images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
    """CIE Lab (L 0 to 100) of sRGB images in [0, 1].

    By kornia on a GPU and where a gradient is wanted; else by OpenCV, which is quicker on a CPU and
    agrees to 0.1 on average and 0.3 at worst, where a bin of `SkinModel` is 2 wide.
    """
    check_shape("images", images, ["B", 3, "H", "W"])
    if images.device.type != "cpu" or (torch.is_grad_enabled() and images.requires_grad):
        from kornia.color import rgb_to_lab as by_kornia

        return by_kornia(images)
    import cv2

    batch, _, height, width = images.shape
    tall = images.permute(0, 2, 3, 1).reshape(batch * height, width, 3)
    lab = cv2.cvtColor(np.ascontiguousarray(tall.float().numpy()), cv2.COLOR_RGB2Lab)
    return torch.from_numpy(lab).view(batch, height, width, 3).permute(0, 3, 1, 2).to(images)


class SkinModel(nn.Module):
    """Probability of skin from the colours of the face, the clothes and the background.

        r(c) = log (p(c | face) + f) / (s p(c | clothes) + (1 - s) p(c | far) + f)
        p(skin | c) = sigmoid(slope (r - bias))

    Every histogram is averaged over time, h <- d h + (1 - d) h_now. Hair and glasses, and hands in
    front of the face, teach no skin; hands in front of the clothes teach no clothes.

    Args:
        slope, bias: of the sigmoid. decay: d. floor: f. clothes_share: s.

    Raises:
        InputError: settings that make no sense.

    Reference:
        Burke & Lasenby, section 5.2: histogram of the face and its exponential average. The
        comparison with what is not skin goes beyond it.

    Example:
        >>> import torch
        >>> from torchpose.measure import SkinModel, rgb_to_lab
        >>> image = torch.zeros(1, 3, 60, 80)
        >>> image[:, :, 10:30, 30:50] = torch.tensor([0.8, 0.6, 0.5])[:, None, None]
        >>> model = SkinModel()
        >>> state, skin = model.step(model.init(1), rgb_to_lab(image), torch.tensor([[40.0, 20, 16]]))
        >>> bool(skin[0, 20, 40] > 0.9) and bool(skin[0, 50, 40] < 0.1)
        True
    """

    def __init__(
        self,
        slope: float = 1.5,
        bias: float = 0.7,
        decay: float = 0.95,
        floor: float = 2e-4,
        clothes_share: float = 0.5,
    ) -> None:
        super().__init__()
        if not (slope > 0 and floor > 0 and 0 <= decay < 1 and 0 <= clothes_share <= 1):
            raise InputError(
                "slope and floor must be positive, decay in [0, 1) and clothes_share in [0, 1], got "
                f"{slope}, {floor}, {decay} and {clothes_share}"
            )
        self.slope, self.bias, self.decay = slope, bias, decay
        self.floor, self.clothes_share = floor, clothes_share
        self.register_buffer("lowest", torch.tensor(_LOWEST))
        self.register_buffer("width", torch.tensor(_WIDTH))
        for axis, kernel in enumerate(_KERNELS):
            self.register_buffer(f"kernel{axis}", torch.tensor(kernel))

    lowest: Tensor
    width: Tensor

    def init(self, batch_size: int) -> SkinState:
        """Nothing is known yet."""
        if batch_size < 1:
            raise InputError(f"batch_size must be at least 1, got {batch_size}")
        even = self.lowest.new_full((batch_size, *BINS), 1 / np.prod(BINS))
        return SkinState(even, even.clone(), even.clone(), 0)

    def step(
        self,
        state: SkinState,
        lab: Float[Tensor, "B 3 H W"],
        faces: Float[Tensor, "B 3"],
        hands: Float[Tensor, "B H W"] | None = None,
    ) -> tuple[SkinState, Float[Tensor, "B H W"]]:
        """Learn from a frame, and find the skin in it.

        Args:
            state: from `init` or the step before. lab: see `rgb_to_lab`.
            faces: centre (x, y) and size of each image's face, pixels.
            hands: probability that a pixel belongs to a hand, as far as it is known.

        Returns:
            The next state, and the probability of skin.

        Raises:
            ShapeError: wrong shapes. InputError: faces without a size.
        """
        check_shape("lab", lab, [len(state.face), 3, "H", "W"])
        check_shape("faces", faces, [len(state.face), 3])
        if not bool((faces[:, 2] > 0).all()):
            raise InputError(f"faces must have a positive size, got {faces[:, 2].tolist()}")
        bins = self.bins(lab)
        state = self._learn(state, bins, faces.to(lab), hands)
        return state, self.probability(
            self.log_ratio(state).flatten(1).gather(1, bins.flatten(1)).view_as(lab[:, 0])
        )

    def bins(self, lab: Float[Tensor, "B 3 H W"]) -> Int[Tensor, "B H W"]:
        """Number of each pixel's bin; colours beyond the histogram count to its border."""
        place = (lab - self.lowest[:, None, None]) / self.width[:, None, None]
        last = torch.tensor(BINS, device=lab.device)[:, None, None] - 1
        light, a, b = place.floor().long().clamp_min(0).minimum(last).unbind(1)
        return (light * BINS[1] + a) * BINS[2] + b

    def log_ratio(self, state: SkinState) -> Float[Tensor, "B 8 32 32"]:
        """r of every colour."""
        share = self.clothes_share
        other = share * state.clothes + (1 - share) * state.far
        return ((state.face + self.floor) / (other + self.floor)).log()

    def probability(self, log_ratio: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """p(skin) of log ratios."""
        bounded = log_ratio.clamp(-_LARGEST_RATIO, _LARGEST_RATIO)
        return torch.sigmoid(self.slope * (bounded - self.bias))

    def _learn(
        self, state: SkinState, bins: Tensor, faces: Tensor, hands: Tensor | None
    ) -> SkinState:
        hands = torch.zeros_like(bins, dtype=faces.dtype) if hands is None else hands
        in_face, in_clothes, in_far = _parts(faces, bins.shape[1:])
        skin = in_face & (hands < _HAND_IN_FACE)
        if state.frames:
            ratio = self.log_ratio(state).flatten(1).gather(1, bins.flatten(1)).view(bins.shape)
            skin = skin & (ratio > _HAIR)
        clothes = in_clothes & (hands < _HAND_ELSEWHERE)
        count = [part.flatten(1).sum(1).to(faces) for part in (skin, in_face, clothes, in_far)]
        enough = count[0] > (_LEAST_FACE * count[1] if state.frames else 0)
        face = self._averaged(state.face, self._histogram(bins, skin), enough, state.frames)
        enough = count[3] >= _LEAST_PIXELS
        far = self._averaged(state.far, self._histogram(bins, in_far), enough, state.frames)
        enough = count[2] >= _LEAST_PIXELS
        worn = self._averaged(state.clothes, self._histogram(bins, clothes), enough, state.frames)
        return SkinState(face, worn, far, state.frames + 1)

    def _averaged(self, old: Tensor, new: Tensor, usable: Tensor, frames: int) -> Tensor:
        decay = self.decay if frames else 0.0
        mixed = decay * old + (1 - decay) * new
        return torch.where(usable[:, None, None, None], mixed, old)

    def _histogram(self, bins: Tensor, part: Tensor) -> Tensor:
        """Smoothed shares of the colours of a part of each image."""
        counts = self.lowest.new_zeros(len(bins), int(np.prod(BINS)))
        counts.scatter_add_(1, bins.flatten(1), part.flatten(1).to(counts))
        smooth = counts.view(-1, 1, *BINS)
        for axis in range(3):
            kernel: Tensor = getattr(self, f"kernel{axis}")
            shape, padding = [1, 1, 1], [0, 0, 0]
            shape[axis], padding[axis] = len(kernel), len(kernel) // 2
            smooth = torch.nn.functional.conv3d(
                smooth, kernel.view(1, 1, *shape), padding=tuple(padding)
            )
        return smooth[:, 0] / smooth.flatten(1).sum(1).clamp_min(1e-6)[:, None, None, None]


def _parts(faces: Tensor, shape: torch.Size) -> tuple[Tensor, Tensor, Tensor]:
    """Where the middle of the face, the clothes and the far background are, bool [B, H, W]."""
    height, width = shape
    x, y, size = faces[:, :, None, None].unbind(1)
    across = ((torch.arange(width, device=faces.device) - x) / size).abs()
    down = (torch.arange(height, device=faces.device)[:, None] - y) / size
    face = (across < _FACE[0]) & (down > _FACE[1]) & (down < _FACE[2])
    clothes = (across < _CLOTHES[0]) & (down > _CLOTHES[1])
    return face, clothes, (across > _FAR[0]) | (down < _FAR[1])
