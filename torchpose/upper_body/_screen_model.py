"""Say how keypoints of a body move and go wrong: the constants of the search for outliers."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.module_state import derived
from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._projection import map_pixels
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.skeleton._upper_body import OTHER_SIDE
from torchpose.upper_body._measured_joints import kept_turn, pixels_per_metre
from torchpose.upper_body._picked import Picked


class _Kind(NamedTuple):
    """Place and motion of joints of one kind.

    Attributes:
        below, spread: the mean place below the neck and the standard deviation about it, metres.
        speed: the standard deviation of the velocity, m/s. brisk: that of its change in a frame in which
            the joint is brisk, m/s.
    """

    below: float
    spread: float
    speed: float
    brisk: float


# Speeds, shares and distances were chosen on s1 to s6 of UTD-MHAD. A place beside the neck is believed up
# to 3.3 spreads where nothing else is known of the joint: a hand within an arm's reach, and beyond it less.
_KINDS = {
    "hand": _Kind(0.1, 0.38, 5.0, 6.0),
    "elbow": _Kind(0.2, 0.27, 1.0, 3.0),
    "shoulder": _Kind(0.08, 0.16, 0.7, 1.5),
    "head": _Kind(-0.2, 0.12, 0.7, 1.5),
    "neck": _Kind(0.0, 0.06, 0.7, 1.5),
}
BRISK = 0.01
"""Share of the frames in which a joint is brisk."""

OUTLIERS = 0.02
"""Share of outliers among the keypoints."""

SLACK = 0.015
"""Metres by which keypoints miss a joint that moves smoothly, beside their R."""

TAKEOVER = 0.25
"""Seconds for which a joint has to be seen elsewhere to be there."""

CERTAIN = 5.0
"""Log-odds that a track has which was seen for so long."""

APART = 0.25
"""Metres between hands that can be told apart."""

_NECK = UPPER_BODY.index("neck")
_ENLARGED = 3.0  # sides of the place where outliers lie, over those of the image
_PERSISTENCE = 0.2  # seconds over which a velocity is forgotten
_SCALES = (0.3, 0.45, 0.67, 1.0, 1.5, 2.25, 3.4)  # sizes of the person relative to the prior's mean
_SCALE_SPREAD, _SCALE_MEMORY = 0.5, 1.0  # deviation of its log; seconds over which it is forgotten
_EXCHANGED, _STILL_EXCHANGED = 0.01, 0.7  # probabilities that hands become so, and stay so


class ScreenModel(NamedTuple):
    """Model of how keypoints move and go wrong, at one frame rate, in the prior's pixels.

    Attributes:
        dt: seconds between two frames. scale: pixels per metre of the prior's mean pose.
        low, high: corners of the region outside of which every pixel is an outlier [2].
        broad: the variance of a joint that may be anywhere in the image.
        start: log (1 - o) (1 - b) / (o u 2 pi) and log (1 - o) b / (o u 2 pi), o the share of outliers, u
            their density and b the share of brisk frames [2].
        moving: the linear map of (var x, cov x v, var v) over one frame [3, 3].
        drift, kept: the seconds for which a velocity moves a joint, and the share of it that is left.
        agitation: the process noise of these moments, at 1 pixel per metre [8, 3].
        jump: the further variance of the place of a brisk joint [8]. lurch: its further (var x, cov x v,
            var v) over that one [3]. speed: the variance of a velocity [8].
        log_scales: the logs of the person's scales over `scale` [G]. usual: their prior log-probability [G].
        memory: the share of their log-weights that a frame keeps.
        below, spread: the place of each joint from the neck at each scale, pixels [G, 8, 2], and its variance
            [G, 8].
        subsets: all subsets of the joints that are present [S, 8]. with_without: the same, and then which
            joints are not in them [S, 16].
        exchanges: for each way to exchange left and right, the joints to take [X, 8]. exchanged: which
            joints these are another one for [X, 8].
        switching: the log-probability of each way after each other one [X, X].
        cov, noise: R of each joint without any confidence [8, 2, 2], and its larger eigenvalue [8].
    """

    dt: float
    scale: float
    low: Tensor
    high: Tensor
    broad: float
    start: Tensor
    moving: Tensor
    drift: float
    kept: float
    agitation: Tensor
    jump: Tensor
    lurch: Tensor
    speed: Tensor
    log_scales: Tensor
    usual: Tensor
    memory: float
    below: Tensor
    spread: Tensor
    subsets: Tensor
    with_without: Tensor
    exchanges: Tensor
    exchanged: Tensor
    switching: Tensor
    cov: Tensor
    noise: Tensor


def kept_screen_model(
    owner: nn.Module,
    prior: UpperBodyPrior,
    camera: PinholeCamera,
    fps: float | None,
    picked: Picked,
    cov: Float[Tensor, "8 2 2"],
) -> ScreenModel:
    """Return `screen_model`, the same one as long as it holds.

    Args:
        owner: the module with which the model is kept. prior, camera, fps: those of the tracker.
        picked: the places of the joints among the keypoints. cov: R of each joint without any confidence.
    """
    info, joints = prior.info, tuple(i >= 0 for i in picked.indices)
    joints = tuple(given or (picked.middle and i == _NECK) for i, given in enumerate(joints))
    mixtures = (*prior.left.parameters_tuple(), *prior.right.parameters_tuple())
    sources = (*mixtures, camera.matrix, camera.up, cov)
    return derived(
        owner,
        ("screen", info.fx, info.fy, info.cx, info.cy, camera.image_size, joints, fps, cov.device),
        sources,
        lambda: screen_model(prior, camera, fps or 30.0, joints, cov),
    )


def screen_model(
    prior: UpperBodyPrior,
    camera: PinholeCamera,
    fps: float,
    joints: tuple[bool, ...],
    cov: Float[Tensor, "8 2 2"],
) -> ScreenModel:
    """Return the model for keypoints of a camera.

    Args:
        prior: the prior, in whose pixels the model is. camera: the camera of the keypoints; without an image
            size the image is taken to be twice as wide and high as its principal point is far from the
            origin (`guessed_size`). fps: frames per second. joints: which of `UPPER_BODY` are among the
            keypoints.
        cov: R of each joint without any confidence, on the device to work on.
    """
    like = torch.zeros((), dtype=torch.float64, device=cov.device)
    corners = _corners(prior, camera, like)
    size, middle = (corners[1] - corners[0]).abs(), corners.mean(0)
    outlier = math.log(OUTLIERS / (1 - OUTLIERS)) - float((_ENLARGED * size).detach().log().sum())
    dt, scale = 1.0 / fps, pixels_per_metre(prior)
    kept = math.exp(-dt / _PERSISTENCE)
    drift = _PERSISTENCE * (1 - kept)
    moving = [[1.0, 0.0, 0.0], [2 * drift, kept, 0.0], [drift**2, kept * drift, kept**2]]
    path = _PERSISTENCE**2 * (2 * dt / _PERSISTENCE - 3 + 4 * kept - kept**2)
    grown = like.new_tensor([path, _PERSISTENCE * (1 - kept) ** 2, 1 - kept**2])
    below, spread, speed, brisk = like.new_tensor([_KINDS[_kind(name)] for name in UPPER_BODY]).mT
    log_scales = like.new_tensor(_SCALES).log()
    sizes = scale * log_scales.exp()[:, None]
    places = torch.stack([torch.zeros_like(sizes * below), sizes * below], -1)
    subsets, exchanges = _subsets(joints).to(like), like.new_tensor(_exchanges(joints)).long()
    start = like.new_tensor([1 - BRISK, BRISK]).log() - outlier - math.log(2 * math.pi)
    return ScreenModel(
        dt, scale, middle - _ENLARGED / 2 * size, middle + _ENLARGED / 2 * size,
        float(size.detach().amax() / 2) ** 2, start,
        like.new_tensor(moving), drift, kept, speed.square()[:, None] * grown,
        (brisk * dt).square(), like.new_tensor([1.0, 1 / dt, 1 / dt**2]), speed.square(), log_scales,
        (-(log_scales / _SCALE_SPREAD).square() / 2).log_softmax(0),
        math.exp(-dt / _SCALE_MEMORY), places, (sizes * spread).square(), subsets,
        torch.cat([subsets, 1 - subsets], 1), exchanges, exchanges != exchanges[0],
        _switching(len(exchanges)).to(like), cov, largest_variance(cov.to(like)),
    )  # fmt: skip


def largest_variance(cov: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch"]:
    """Return the larger eigenvalue of each covariance."""
    a, b, c, d = cov.flatten(-2).unbind(-1)
    return (a + d) / 2 + (((a - d) / 2).square() + b * c).clamp_min(0.0).sqrt()


def _corners(prior: UpperBodyPrior, camera: PinholeCamera, like: Tensor) -> Float[Tensor, "2 2"]:
    """Return two opposite corners of the box, in the prior's pixels, that the image lies in."""
    own, wanted = camera.matrix.to(like), prior.info.matrix.to(like)
    ends = torch.stack([like.new_zeros(2), guessed_size(camera).to(like)])
    turn = kept_turn(camera, prior)
    if turn is None:
        return map_pixels(ends, own, wanted)
    places = torch.cat([torch.cartesian_prod(*ends.T), ends.mean(0, keepdim=True)])
    places = map_pixels(places, own, wanted)
    turned = turn.points(places)[turn.visible(places, wanted)]
    return torch.stack([turned.amin(0), turned.amax(0)])


def _kind(name: str) -> str:
    return name.split("_")[0]


def guessed_size(camera: PinholeCamera) -> Float[Tensor, "2"]:
    """Return width and height of the image, or a guess that is not much too small.

    An image whose principal point is near its edge, or beside it, is cut from a larger one.
    """
    if camera.image_size is not None:
        return torch.tensor(camera.image_size, dtype=torch.float64)
    middle, focal = camera.matrix[:2, 2], camera.matrix.diagonal()[:2]
    aside = 2 * middle < focal / 2
    return torch.where(aside, middle.clamp_min(0.0) + focal, 2 * middle)


def _subsets(present: tuple[bool, ...]) -> Float[Tensor, "S 8"]:
    """Return all subsets of the joints that are present."""
    there = [i for i, given in enumerate(present) if given]
    rows = torch.arange(2 ** len(there))
    chosen = torch.zeros(len(rows), len(present))
    chosen[:, there] = (rows[:, None] >> torch.arange(len(there)) & 1).to(chosen)
    return chosen


def _exchanges(present: tuple[bool, ...]) -> list[list[int]]:
    """Return the joints to take as measured, with hands exchanged, and with hands and elbows exchanged."""
    ways = [list(range(8))]
    for kinds in (("hand",), ("hand", "elbow")):
        pairs = [i for i, name in enumerate(UPPER_BODY) if _kind(name) in kinds]
        if all(present[i] for i in pairs):
            ways.append([OTHER_SIDE[i] if i in pairs else i for i in range(8)])
    return ways


def _switching(n_ways: int) -> Float[Tensor, "X X"]:
    """Return the log-probability of each way of exchange after each other one."""
    switching = torch.eye(n_ways, dtype=torch.float64)
    if n_ways > 1:
        switching *= _STILL_EXCHANGED
        switching[:, 0] = 1 - _STILL_EXCHANGED
        switching[0, 1:] = _EXCHANGED / (n_ways - 1)
        switching[0, 0] = 1 - _EXCHANGED
    return switching.log()
