"""Detect skin in colour images from a histogram of the face (Burke & Lasenby, section 5.2).

The paper back-projects the colours of a detected face. Clothes and walls may have colours of skin, so
the face is compared with the clothes below it and with the image far from the person.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn

from torchpose._core.checks import check_count, check_shape
from torchpose.errors import InputError
from torchpose.measure._face_detector import check_faces

BINS = (8, 32, 32)  # of L, a and b
_LOWEST, _WIDTH = (0.0, -24.0, -24.0), (12.5, 2.0, 3.0)
_KERNELS = ((0.1, 0.8, 0.1), (0.05, 0.24, 0.42, 0.24, 0.05), (0.05, 0.24, 0.42, 0.24, 0.05))
# Parts of the image, in sizes of the face from its centre.
FACE_PATCH = (0.25, -0.2, 0.35)  # half the width, top, bottom
_CLOTHES = (0.75, 1.15)  # half the width, top
_FAR = (2.6, -0.9)  # beyond this to either side, or above this
_LEAST_FACE, _LEAST_PIXELS = 0.3, 50.0  # share of the patch, and pixels of the others
_HAND_IN_FACE, _HAND_ELSEWHERE, _HAIR = 0.3, 0.25, -0.5
_LARGEST_RATIO = 4.0


class SkinState(NamedTuple):
    """Holds the histograms of B persons, exponentially averaged; each sums to one.

    Attributes:
        face, clothes, far: [B, 8, 32, 32] over L, a and b. frames: seen so far [B].
    """

    face: Float[Tensor, "B 8 32 32"]
    clothes: Float[Tensor, "B 8 32 32"]
    far: Float[Tensor, "B 8 32 32"]
    frames: Int[Tensor, " B"]


class PersonParts(NamedTuple):
    """Holds masks of images of B persons: the middle of the face, the clothes, and what is far from both."""

    face: Bool[Tensor, "B H W"]
    clothes: Bool[Tensor, "B H W"]
    far: Bool[Tensor, "B H W"]


def rgb_to_lab(images: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
    """Return CIE Lab (L 0 to 100) of sRGB images in [0, 1].

    By kornia on a GPU and where a gradient is wanted; else by OpenCV, which is quicker on a CPU and
    agrees to 0.1 on average and 0.3 at worst, where a bin of `SkinModel` is 2 wide.
    """
    check_shape("images", images, ["B", 3, "H", "W"])
    if images.device.type != "cpu" or (torch.is_grad_enabled() and images.requires_grad):
        from kornia.color import rgb_to_lab as by_kornia

        return by_kornia(images)
    if not images.numel():
        return images
    import cv2

    batch, _, height, width = images.shape
    tall = images.permute(0, 2, 3, 1).reshape(batch * height, width, 3)
    lab = cv2.cvtColor(np.ascontiguousarray(tall.float().numpy()), cv2.COLOR_RGB2Lab)
    return torch.from_numpy(lab).view(batch, height, width, 3).permute(0, 3, 1, 2).to(images)


class SkinModel(nn.Module):
    """Computes the probability of skin from the colours of the face, the clothes and the background.

        r(c) = log (p(c | face) + f) / (s p(c | clothes) + (1 - s) p(c | far) + f)
        p(skin | c) = sigmoid(slope (r - bias))

    Every histogram is averaged over time, h <- d h + (1 - d) h_now. Hair, glasses and hands in front of
    the face are left out of the face's histogram, hands in front of the clothes out of the clothes'.

    Args:
        slope, bias: of the sigmoid. decay: d. floor: f. clothes_share: s.

    Raises:
        InputError: settings out of range.

    Reference:
        Burke & Lasenby, section 5.2: histogram of the face and its exponential average. The
        comparison with what is not skin goes beyond it.

    Example:
        >>> import torch
        >>> from torchpose.measure._skin import SkinModel, rgb_to_lab
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
        self.register_buffer("lowest", torch.tensor(_LOWEST, dtype=torch.float32))
        self.register_buffer("width", torch.tensor(_WIDTH, dtype=torch.float32))
        for axis, kernel in enumerate(_KERNELS):
            self.register_buffer(f"smooth{axis}", _band(BINS[axis], kernel))

    lowest: Tensor
    width: Tensor
    smooth0: Tensor
    smooth1: Tensor
    smooth2: Tensor

    def init(self, batch_size: int) -> SkinState:
        """Return the state before the first frame."""
        check_count("batch_size", batch_size)
        even = self.lowest.new_full((batch_size, *BINS), 1 / np.prod(BINS))
        frames = torch.zeros(batch_size, dtype=torch.long, device=even.device)
        return SkinState(even, even.clone(), even.clone(), frames)

    def step(
        self,
        state: SkinState,
        lab: Float[Tensor, "B 3 H W"],
        faces: Float[Tensor, "B 3"],
        hands: Float[Tensor, "B H W"] | None = None,
    ) -> tuple[SkinState, Float[Tensor, "B H W"]]:
        """Learn from a frame, and return the probability of skin in it; see `SkinMixtureModel.step`."""
        check_shape("lab", lab, [len(state.face), 3, "H", "W"])
        check_faces(faces, len(state.face))
        bins = self.bins(lab)
        parts = parts_of_persons(faces.to(self.lowest), bins.shape[1:])
        state = self.learn(state, bins, parts, hands)
        return state, self.find(state, bins)

    def find(self, state: SkinState, bins: Int[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
        """Return the probability of skin of pixels whose bins are known (`bins`, `byte_bins`)."""
        table = self.probability(self.log_ratio(state)).flatten()
        first = torch.arange(len(bins), dtype=bins.dtype, device=bins.device) * int(np.prod(BINS))
        flat = (bins + first[:, None, None]).flatten()
        return table.index_select(0, flat).view(bins.shape)

    def byte_bins(self, lab: UInt8[Tensor, "B 3 H W"]) -> Int[Tensor, "B H W"]:
        """Return the numbers of the bins of Lab in bytes, as OpenCV has it: 255/100 L, a + 128, b + 128.

        The steps of L are 32 of 255 instead of 12.5 of 100, which is the same to 0.4 %.
        """
        light, a, b = lab.to(torch.int16).unbind(1)
        a = ((a - 104) >> 1).clamp_(0, BINS[1] - 1)
        b = (((b - 104) * 171) >> 9).clamp_(0, BINS[2] - 1)  # a third, without a division
        return (((light >> 5) << 10) + (a << 5) + b).int()

    def bins(self, lab: Float[Tensor, "B 3 H W"]) -> Int[Tensor, "B H W"]:
        """Return the number of each pixel's bin; colours beyond the histogram count to its border."""
        place = (lab - self.lowest[:, None, None]) / self.width[:, None, None]
        last = torch.tensor(BINS, device=lab.device)[:, None, None] - 1
        light, a, b = place.floor().long().clamp_min(0).minimum(last).unbind(1)
        return (light * BINS[1] + a) * BINS[2] + b

    def log_ratio(self, state: SkinState) -> Float[Tensor, "B 8 32 32"]:
        """Return the log ratio r of every colour."""
        share = self.clothes_share
        other = share * state.clothes + (1 - share) * state.far
        return ((state.face + self.floor) / (other + self.floor)).log()

    def probability(self, log_ratio: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        """Return p(skin) of log ratios."""
        bounded = log_ratio.clamp(-_LARGEST_RATIO, _LARGEST_RATIO)
        return torch.sigmoid(self.slope * (bounded - self.bias))

    def learn(
        self,
        state: SkinState,
        bins: Int[Tensor, "B H W"],
        parts: PersonParts,
        hands: Float[Tensor, "B H W"] | None = None,
        valid: Bool[Tensor, "B H W"] | None = None,
    ) -> SkinState:
        """Return the state after a frame.

        Args:
            state, hands: see `step`. bins: of every pixel, or of every second one.
            parts: `parts_of_persons` there. valid: which pixels belong to the image; the others are left out.
        """
        known = state.frames > 0
        patch, clothes, far = self._colours(bins, parts, hands, valid)
        hair = known[:, None] & (self.log_ratio(state).flatten(1) <= _HAIR)
        skin = torch.where(hair, 0.0, patch[:, 0])
        least = torch.where(known, _LEAST_FACE * patch.sum((1, 2)), 0.0)
        counts = torch.stack([skin, clothes, far], 1)
        total = counts.sum(2)
        usable = torch.cat([total[:, :1] > least[:, None], total[:, 1:] >= _LEAST_PIXELS], 1)
        old = torch.stack(state[:3], 1)
        decay = torch.where(known, self.decay, 0.0).to(old)[:, None].expand_as(usable)
        share = torch.where(usable, 1 - decay, 0.0)[..., None, None, None]
        mixed = old.lerp(self._smoothed(counts), share)
        return SkinState(mixed[:, 0], mixed[:, 1], mixed[:, 2], state.frames + 1)

    def _colours(
        self, bins: Tensor, parts: PersonParts, hands: Tensor | None, valid: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the colours of the face and of hands in front of it [B, 2, C], clothes and far [B, C]."""
        face, clothes, far = parts
        if hands is not None:
            clothes = clothes & (hands < _HAND_ELSEWHERE)
        label = face.byte() + 3 * clothes.byte() + 4 * far.byte()
        if hands is not None:
            label += face & (hands >= _HAND_IN_FACE)
        if valid is not None:
            label *= valid
        counts = self._counts(bins, label)
        return counts[:, 1:3], counts[:, 3], counts[:, 4]

    def _counts(self, bins: Tensor, label: Tensor) -> Tensor:
        """Return the number of pixels of each label (0 to 4) and bin [B, 5, C]."""
        batch, size = len(bins), int(np.prod(BINS))
        first = 5 * torch.arange(batch, dtype=bins.dtype, device=bins.device)
        index = (first[:, None, None] + label.to(bins.dtype)) * size + bins
        counts = torch.bincount(index.flatten(), minlength=5 * batch * size)
        return counts.view(batch, 5, size).to(self.lowest)

    def _smoothed(self, counts: Tensor) -> Tensor:
        """Return the shares of the colours [B, 3, 8, 32, 32], each axis smoothed by a product with a band."""
        smooth = counts.view(-1, BINS[2]) @ self.smooth2
        smooth = _times_each(self.smooth1, smooth.view(-1, BINS[1], BINS[2]))
        smooth = _times_each(self.smooth0, smooth.view(-1, BINS[0], BINS[1] * BINS[2]))
        smooth = smooth.view(*counts.shape[:2], *BINS)
        return smooth / smooth.sum((2, 3, 4), keepdim=True).clamp_min(1e-6)


def _times_each(
    matrix: Float[Tensor, "r r"], values: Float[Tensor, "N r c"]
) -> Float[Tensor, "N r c"]:
    """Return the product of a matrix with each of the others; `@` would copy these."""
    return matrix.expand(len(values), -1, -1).bmm(values)


def _band(size: int, kernel: tuple[float, ...]) -> Tensor:
    """Return the symmetric matrix of a convolution with a symmetric kernel, zero beyond the ends."""
    middle, eye = len(kernel) // 2, torch.eye(size, dtype=torch.float32)
    rows = torch.nn.functional.pad(eye, (middle, middle))
    return sum(  # type: ignore[return-value]
        weight * rows[:, i : i + size] for i, weight in enumerate(kernel)
    )


def parts_of_persons(faces: Float[Tensor, "B 3"], shape: Sequence[int]) -> PersonParts:
    """Return where the parts of persons are, given their faces (x, y, size), and the shape of the image."""
    height, width = shape
    x, y, size = (column[:, None] for column in faces.unbind(1))
    across = ((torch.arange(width, device=faces.device) - x) / size).abs()[:, None]
    down = ((torch.arange(height, device=faces.device) - y) / size)[:, :, None]
    face = (down > FACE_PATCH[1]) & (down < FACE_PATCH[2]) & (across < FACE_PATCH[0])
    clothes = (down > _CLOTHES[1]) & (across < _CLOTHES[0])
    return PersonParts(face, clothes, (down < _FAR[1]) | (across > _FAR[0]))
