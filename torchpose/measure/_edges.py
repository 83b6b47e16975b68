"""Find straight edges, and count those that support a limb (Burke & Lasenby, section 5.3, BL 50)."""

import math
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchpose._core.checks import check_shape
from torchpose._core.images import Image
from torchpose.errors import InputError
from torchpose.skeleton._joint_sets import UPPER_BODY

Backend = Literal["auto", "opencv", "kornia"]
ARM_LIMBS = tuple(
    (UPPER_BODY.index(f"{upper}_{side}"), UPPER_BODY.index(f"{lower}_{side}"))
    for side in ("left", "right")
    for upper, lower in (("shoulder", "elbow"), ("elbow", "hand"))
)
"""Pairs of `UPPER_BODY` indices: upper arm and forearm, left and right."""

_BLUR = (5, 1.0)  # size and deviation of the Gaussian before the gradient, pixels
_FACE_PIXELS = 32.0  # size of a face where segments are searched for
_MARGIN = 0.6  # about the arms, in sizes of the face


class Segments(NamedTuple):
    """Holds the S straight edge segments of an image.

    Attributes:
        midpoint: (x, y), pixels [S, 2]. angle: against the x axis, in [0, pi) [S].
        length: pixels [S].
    """

    midpoint: Float[Tensor, "S 2"]
    angle: Float[Tensor, " S"]
    length: Float[Tensor, " S"]


def edge_map(
    image: Image | Float[Tensor, "H W"],
    low: float = 40.0,
    high: float = 100.0,
    backend: Backend = "auto",
) -> Bool[Tensor, "H W"]:
    """Return the edges of a grey image by Canny's detector.

    Args:
        image: grey levels 0 to 255. low, high: thresholds of the gradient by Sobel's kernels,
            which give 8 for a slope of one grey level per pixel.
        backend: "kornia" works on tensors of any device; "opencv" is quicker on a CPU; "auto" takes
            kornia for tensors on a GPU or with a gradient.

    Raises:
        InputError: an unknown backend, another kind of image.

    Reference:
        J. Canny (1986), as cited by Burke & Lasenby, section 5.3.
    """
    if backend not in ("auto", "opencv", "kornia"):
        raise InputError(f"backend must be 'auto', 'opencv' or 'kornia', got {backend!r}")
    if len(image.shape) != 2 or (isinstance(image, np.ndarray) and image.dtype != np.uint8):
        raise InputError(
            f"image must be grey, [H, W] of uint8 or a tensor, got {list(image.shape)} of {image.dtype}"
        )
    if backend == "auto":
        special = isinstance(image, Tensor) and (image.device.type != "cpu" or image.requires_grad)
        backend = "kornia" if special else "opencv"
    if backend == "kornia":
        return _by_kornia(torch.as_tensor(image), low, high)
    if isinstance(image, Tensor):
        image = image.detach().clamp(0, 255).round().to(torch.uint8).cpu().numpy()
    return torch.from_numpy(_by_opencv(image, low, high) > 0)


def _by_opencv(image: Image, low: float, high: float) -> Image:
    import cv2

    if not image.size:
        return np.zeros(image.shape, np.uint8)
    size, deviation = _BLUR
    smooth = cv2.GaussianBlur(np.ascontiguousarray(image), (size, size), deviation)
    return np.asarray(cv2.Canny(smooth, low, high, L2gradient=True), np.uint8)


def _by_kornia(image: Tensor, low: float, high: float) -> Tensor:
    from kornia.filters import canny

    real = image if image.is_floating_point() else image.float()
    size, deviation = _BLUR
    _, edges = canny(
        real[None, None] / 255, low / 255, high / 255, (size, size), (deviation, deviation)
    )
    return edges[0, 0] > 0


def find_segments(
    image: Image | Float[Tensor, "H W"],
    backend: Backend = "auto",
    low: float = 40.0,
    high: float = 100.0,
    votes: int = 12,
    least_length: float = 8.0,
    largest_gap: float = 3.0,
) -> Segments:
    """Return straight edges by Canny's detector and the probabilistic Hough transform.

    Kornia has no Hough transform: its edges go to OpenCV's.

    Args:
        image: grey levels 0 to 255. backend, low, high: see `edge_map`.
        votes: edge pixels that a line needs. least_length, largest_gap: of a segment, pixels.

    Reference:
        J. Matas, C. Galambos, J. Kittler (2000), as cited by Burke & Lasenby, section 5.3.

    Example:
        >>> import numpy as np
        >>> from torchpose.measure._edges import find_segments
        >>> image = np.zeros((60, 80), np.uint8)
        >>> image[:, 40:] = 200
        >>> found = find_segments(image)
        >>> [round(x) for x in found.midpoint[0].tolist()], round(float(found.angle[0]), 2)
        ([39, 30], 1.57)
    """
    import cv2

    edges = edge_map(image, low, high, backend)
    pixels = edges.cpu().numpy().astype(np.uint8) * 255
    found = None
    if pixels.any():
        found = cv2.HoughLinesP(
            pixels, 1.0, math.pi / 90, votes, minLineLength=least_length, maxLineGap=largest_gap
        )
    ends = np.zeros((0, 4)) if found is None else np.asarray(found).reshape(-1, 4)
    return _segments(torch.from_numpy(ends.astype(np.float32)))


def _segments(ends: Float[Tensor, "S 4"]) -> Segments:
    first, second = ends[:, :2], ends[:, 2:]
    along = second - first
    angle = torch.atan2(along[:, 1], along[:, 0]).remainder(math.pi)
    return Segments((first + second) / 2, angle, along.norm(dim=1))


def limb_votes(
    segments: Segments,
    starts: Float[Tensor, "*b 2"],
    ends: Float[Tensor, "*b 2"],
    position_std: Float[Tensor, "*b"] | float,
    angle_std: float = 0.2,
    threshold: float = 0.3,
    along: bool = True,
) -> Float[Tensor, "*b"]:
    """Return the number of segments that support each hypothesis of a limb.

        N(x_edge | x_pose, Sigma) > tau,   x = (u, v, angle),   Sigma = diag(s^2, s^2, a^2)   (BL 50)

    Angles are compared modulo pi. A limb that is not finite gets no votes.

    Args:
        segments: S edges. starts, ends: of the limbs, pixels.
        position_std: s, pixels. angle_std: a, radians.
        threshold: tau, in units of the density's peak, so that it does not depend on Sigma.
        along: take the limb's point nearest to the edge's midpoint for its place; False takes the
            middle of the limb, as published, which misses edges near the ends of long limbs.

    Returns:
        Number of segments above the threshold.

    Raises:
        ShapeError: starts and ends that do not fit together. InputError: deviations or a threshold
            out of range.

    Example:
        >>> import torch
        >>> from torchpose.measure._edges import Segments, limb_votes
        >>> edge = Segments(torch.tensor([[20.0, 12]]), torch.tensor([0.0]), torch.tensor([10.0]))
        >>> starts, ends = torch.tensor([[10.0, 10], [20, 0]]), torch.tensor([[40.0, 10], [20, 30]])
        >>> limb_votes(edge, starts, ends, 3.0).tolist()  # along the edge, across it
        [1.0, 0.0]
    """
    check_shape("starts", starts, ["...", 2])
    check_shape("ends", ends, list(starts.shape))
    spread = torch.as_tensor(position_std, dtype=starts.dtype, device=starts.device)
    if bool((spread <= 0).any()) or not angle_std > 0 or not 0 < threshold < 1:
        raise InputError(
            "position_std and angle_std must be positive and threshold in (0, 1), got "
            f"{position_std}, {angle_std} and {threshold}"
        )
    midpoint, angle = segments.midpoint.to(starts), segments.angle.to(starts)
    limb = (ends - starts)[..., None, :]
    from_start = midpoint - starts[..., None, :]
    if along:
        share = (from_start * limb).sum(-1) / limb.square().sum(-1).clamp_min(1e-9)
        share = share.clamp(0, 1)
    else:
        share = torch.full_like(from_start[..., 0], 0.5)
    place = (from_start - share[..., None] * limb).square().sum(-1) / spread[..., None].square()
    turn = angle - torch.atan2(limb[..., 1], limb[..., 0])
    turn = (turn + math.pi / 2).remainder(math.pi) - math.pi / 2
    squared = place + (turn / angle_std).square()
    return (squared < -2 * math.log(threshold)).sum(-1).to(starts)


def segments_of_arms(
    grey: Image, joints: Float[Tensor, "*b 8 2"], size: float, **options: float
) -> Segments:
    """Return the segments about the arms, found where a face has 32 pixels, in pixels of the frame.

    Args:
        grey: [H, W], uint8. joints: all hypotheses of all arms, order of `UPPER_BODY`, pixels.
        size: of the face, pixels. options: see `find_segments`.
    """
    import cv2

    arms = [index for limb in ARM_LIMBS for index in limb]
    points = joints[..., arms, :].reshape(-1, 2)
    points = points[torch.isfinite(points).all(1)]
    if not len(points):
        return _segments(torch.zeros(0, 4))
    limit = torch.tensor([grey.shape[1], grey.shape[0]]).to(points)
    low = (points.amin(0) - _MARGIN * size).clamp_min(0).minimum(limit).long()
    high = (points.amax(0) + _MARGIN * size).clamp_min(0).minimum(limit).long()
    part = grey[int(low[1]) : int(high[1]), int(low[0]) : int(high[0])]
    scale = min(1.0, _FACE_PIXELS / size)
    shape = [round(n * scale) for n in part.shape]
    if min(shape) < 1:
        return _segments(torch.zeros(0, 4))
    small = cv2.resize(part, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    found = find_segments(np.asarray(small, np.uint8), **options)  # type: ignore[arg-type]
    midpoint = (found.midpoint + 0.5) / scale - 0.5 + low.to(found.midpoint)
    return Segments(midpoint, found.angle, found.length / scale)
