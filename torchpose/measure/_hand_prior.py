"""Tabulate where hands and elbows are relative to the face (after Burke & Lasenby, section 3)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.checks import check_shape
from torchpose._core.module_state import derived, register_given
from torchpose.errors import InputError, PriorError
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.priors._upper_body_prior import UpperBodyPrior

FACE_HEIGHT = 0.165  # metres: side of the bounding box of the face detector, B
_STEP, _LEFT, _TOP, _SIZE = 0.1, -5.0, -2.5, (91, 101)  # the tables, in B from the face
_HAND, _ELBOW, _HEAD, _DEPTH = slice(0, 2), slice(3, 5), slice(9, 11), 11
_NEAREST = 0.3  # metres: a depth below it is a tail of a Gaussian, not a person
_SMOOTH, _ANYWHERE, _VAGUE = 0.2, 0.05, 1e-4
_NODES, _CHUNK = 5, 4096


class HandPrior(nn.Module):
    """Holds the log density of a hand relative to the face, and the expected elbow, as tables.

        o = (h - f) lambda / (focal FACE_HEIGHT),   log p(o) and E[e | o]

    with hand h, head f (the face's centre), elbow e in pixels and the head's depth lambda; o is in
    face heights B. A share of 5 % is uniform over the table, for poses that the prior has not seen.

    Args:
        table: log density, x and y of the elbow, for the left and the right arm [2, 3, 91, 101].

    Reference:
        Burke & Lasenby, section 3.1 (the mixtures). The table goes beyond the paper.

    Example:
        >>> import torch, torchpose
        >>> from torchpose.measure._hand_prior import HandPrior
        >>> prior = HandPrior.from_prior(torchpose.load_prior("kinect-upper-body"))
        >>> log_density, elbow = prior(torch.tensor([[1.5, 4.0], [-1.5, 4.0]]))
        >>> bool(log_density[0, 0] > log_density[1, 0]) and bool(elbow[0, 0, 0] > 0)
        True
    """

    def __init__(self, table: Float[Tensor, "2 3 91 101"]) -> None:
        super().__init__()
        check_shape("table", table, [2, 3, *_SIZE])
        register_given(self, "table", table)

    table: Tensor

    @classmethod
    def from_prior(cls, prior: "UpperBodyPrior | HandPrior") -> "HandPrior":
        """Return the tables of a prior over poses, for any camera; what holds tables is returned as it is.

        The depth of the head is summed over five nodes of Gauss-Hermite quadrature; given it, the
        offsets are Gaussian for every component, so nothing is sampled.

        Raises:
            InputError: a prior whose heads are all behind or too near the camera. PriorError: something else.
        """
        if isinstance(prior, HandPrior):
            return prior
        if not isinstance(prior, UpperBodyPrior):
            raise PriorError(
                f"prior must be an UpperBodyPrior, got {type(prior).__name__}; see torchpose.load_prior"
            )
        focal = (prior.info.fx, prior.info.fy)
        arms = (prior.left, prior.right)
        sources = tuple(x for arm in arms for x in arm.parameters_tuple())
        with torch.no_grad():
            table = derived(
                prior, ("hands", focal), sources,
                lambda: torch.stack([_arm_table(arm, focal) for arm in arms]).float(),
            )  # fmt: skip
        return cls(table)

    def forward(
        self, offsets: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "2 *batch"], Float[Tensor, "2 2 *batch"]]:
        """Look up places; beyond the table its border is repeated.

        Args:
            offsets: (x, y) from the face's centre, in B.

        Returns:
            Log density [left or right, ...] per B squared, and the expected elbow [left or right,
            x or y, ...] in B from the face's centre.
        """
        half = offsets.new_tensor([_SIZE[1] - 1, _SIZE[0] - 1]) * (_STEP / 2)
        first = offsets.new_tensor([_LEFT, _TOP])
        grid = ((offsets - first) / half - 1).reshape(1, 1, -1, 2)
        found = nn.functional.grid_sample(
            self.table.view(1, 6, *_SIZE).to(offsets),
            grid,
            mode="bilinear",
            padding_mode="border",
            align_corners=True,
        ).view(2, 3, *offsets.shape[:-1])
        return found[:, 0], found[:, 1:]


def _arm_table(mixture: GaussianMixture, focal: tuple[float, float]) -> Float[Tensor, "3 h w"]:
    weights, means, covs = _offsets(mixture, focal)
    spread = covs[:, :2, :2] + _SMOOTH**2 * torch.eye(2, dtype=covs.dtype)
    density, elbow = _density_and_elbow(_cell_places(), weights, means, covs[:, 2:, :2], spread)
    average = (weights[:, None] * means[:, 2:]).sum(0)
    elbow = (elbow + _VAGUE * average) / (density + _VAGUE)[:, None]
    area = _SIZE[0] * _SIZE[1] * _STEP**2
    density = (1 - _ANYWHERE) * density / (density.sum() * _STEP**2) + _ANYWHERE / area
    return torch.cat([density.log()[:, None], elbow], 1).T.reshape(3, *_SIZE)


def _cell_places() -> Float[Tensor, "P 2"]:
    x = _LEFT + _STEP * torch.arange(_SIZE[1], dtype=torch.float64)
    y = _TOP + _STEP * torch.arange(_SIZE[0], dtype=torch.float64)
    return torch.stack(torch.broadcast_tensors(x, y[:, None]), -1).reshape(-1, 2)


def _offsets(
    mixture: GaussianMixture, focal: tuple[float, float]
) -> tuple[Float[Tensor, " M"], Float[Tensor, "M 4"], Float[Tensor, "M 4 4"]]:
    """Return the hand and elbow from the head, in B, as a mixture: every component at every depth."""
    mean, cov = mixture.means.double(), mixture.covariances.double()
    node, share = _hermite(_NODES)
    spread = cov[:, _DEPTH, _DEPTH].sqrt()
    depth = mean[:, _DEPTH, None] + spread[:, None] * node  # [K, J]
    weights = mixture.weights.double()[:, None] * share * (depth > _NEAREST)
    if not bool(weights.sum() > 0):
        raise InputError(
            f"expected a prior whose heads are at depths above {_NEAREST} m, got means "
            f"{mean[:, _DEPTH].tolist()}; check the camera and the units of its states"
        )
    pick = mean.new_zeros(4, mean.shape[1])
    for row, part in ((0, _HAND), (2, _ELBOW)):
        pick[row : row + 2, part] = torch.eye(2, dtype=mean.dtype)
        pick[row : row + 2, _HEAD] = -torch.eye(2, dtype=mean.dtype)
    gain = cov[:, :, _DEPTH] / cov[:, _DEPTH, _DEPTH, None]  # regression on the depth
    moved = mean[:, None] + (node * spread[:, None])[..., None] * gain[:, None]
    left = cov - gain[:, :, None] * cov[:, None, :, _DEPTH]
    focal_b = FACE_HEIGHT * mean.new_tensor([*focal, *focal])
    scale = depth[..., None] / focal_b  # B per pixel, [K, J, 4]
    means = (moved @ pick.T) * scale
    covs = (pick @ left @ pick.T)[:, None] * scale[..., :, None] * scale[..., None, :]
    kept = weights.flatten() > 0
    weights = weights.flatten()[kept]
    return weights / weights.sum(), means.flatten(0, 1)[kept], covs.flatten(0, 1)[kept]


def _hermite(nodes: int) -> tuple[Float[Tensor, " J"], Float[Tensor, " J"]]:
    """Return the nodes and weights for expectations under N(0, 1): eigenvalues of the Jacobi matrix."""
    off = torch.arange(1, nodes, dtype=torch.float64).sqrt()
    place, vectors = torch.linalg.eigh(torch.diag(off, 1) + torch.diag(off, -1))
    return place, vectors[0].square()


def _density_and_elbow(
    places: Float[Tensor, "P 2"],
    weights: Float[Tensor, " M"],
    means: Float[Tensor, "M 4"],
    cross: Float[Tensor, "M 2 2"],
    spread: Float[Tensor, "M 2 2"],
) -> tuple[Float[Tensor, " P"], Float[Tensor, "P 2"]]:
    """Return p(o) and p(o) E[e | o] at every place.

    Both are sums over components of exp(quadratic) times (1, affine), so they are products of
    matrices with the monomials of the places.
    """
    precision = torch.linalg.inv(spread)
    regress = cross @ precision  # e = a + R o
    start = means[:, 2:] - (regress @ means[:, :2, None])[..., 0]
    (pxx, pxy), (_, pyy) = (precision[:, i].unbind(1) for i in (0, 1))
    mx, my = means[:, 0], means[:, 1]
    constant = weights.log() - 0.5 * spread.det().log() - math.log(2 * math.pi)
    constant = constant - 0.5 * (pxx * mx * mx + 2 * pxy * mx * my + pyy * my * my)
    linear = torch.stack([pxx * mx + pxy * my, pxy * mx + pyy * my])
    terms = torch.cat([constant[None], linear, torch.stack([-pxx / 2, -pxy, -pyy / 2])])
    values = torch.cat([torch.ones_like(weights)[:, None], start, regress.flatten(1)], 1)  # 1, a, R
    found = []
    for chunk in places.split(_CHUNK):
        x, y = chunk.unbind(1)
        monomials = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], 1)
        found.append((monomials @ terms).exp() @ values)
    total = torch.cat(found)
    elbow = total[:, 1:3] + (total[:, 3:].view(-1, 2, 2) @ places[..., None])[..., 0]
    return total[:, 0], elbow
