"""Silhouette pixels under single limbs, those that the opposing limb may explain counted half."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose.body.limb_outlines import NEAR
from torchpose.body.limbs import Limbs, check_limbs
from torchpose.body.silhouette import PreparedSilhouettes, count_pixels, prepare_silhouettes
from torchpose.camera_rig import Cameras
from torchpose.errors import ShapeError

__all__ = ["count_limbs"]


def count_limbs(
    limbs: Limbs,
    opposing: Limbs | None,
    cameras: Cameras,
    silhouettes: Tensor | PreparedSilhouettes,
    *,
    chunk: int | None = None,
    near: float = NEAR,
) -> Float[Tensor, "*batch S C"]:
    """Weight of each limb position by itself: the sum of a silhouette that is 1/2 under the other limb.

    sum_{l in L} B_opp(l) = |L and fg| - 1/2 |L and fg and U|   (DX 4)

    with L the pixels of one position, fg the silhouette, and U the union of the positions at which the
    opposing limb (the other arm or leg) is expected.

    Args:
        limbs: S positions of a limb, each counted apart: [*batch, S, 3], radii [S, 2] or
            [*batch, S, 2]. The leading dimensions may hold hypotheses and limbs.
        opposing: O positions of the opposing limb, [*batch, O, 3]; None if there is none.
        cameras: C of them, with images of the silhouettes' size.
        silhouettes: as for `count_pixels`.
        chunk: positions at a time. near: metres.

    Returns:
        [*batch, S, C], float64, pixels.

    Raises:
        ShapeError: the leading dimensions differ; others as `count_pixels`.

    Reference: Daubney & Xie, section 5 and equation (4).
    """
    check_limbs(limbs)
    if not isinstance(silhouettes, PreparedSilhouettes):
        silhouettes = prepare_silhouettes(silhouettes)
    alone = Limbs(limbs.start.unsqueeze(-2), limbs.end.unsqueeze(-2), limbs.radii.unsqueeze(-2))

    def overlap(parts: Limbs) -> Tensor:
        return count_pixels(parts, None, cameras, silhouettes, chunk=chunk, near=near).overlap

    inside = overlap(alone).double()
    if opposing is None:
        return inside
    check_limbs(opposing)
    batch, n_positions = tuple(limbs.start.shape[:-2]), limbs.start.shape[-2]
    if tuple(opposing.start.shape[:-2]) != batch:
        raise ShapeError(
            f"the opposing limb must have the leading dimensions {list(batch)} of the limb, got "
            f"{list(opposing.start.shape[:-2])}"
        )
    both = Limbs(*(_beside(a, b, n_positions) for a, b in zip(alone, opposing, strict=True)))
    # |L and U| = |L| + |U| - |L or U|, each within the silhouette
    shared = inside + overlap(opposing).unsqueeze(-2) - overlap(both)
    return inside - shared / 2


def _beside(alone: Tensor, opposing: Tensor, n_positions: int) -> Tensor:
    """[..., S, 1, k] and [..., O, k] as [..., S, 1 + O, k]."""
    opposing = opposing.unsqueeze(-3).expand(*opposing.shape[:-2], n_positions, -1, -1)
    batch = torch.broadcast_shapes(alone.shape[:-2], opposing.shape[:-2])
    parts = (alone.expand(*batch, -1, -1), opposing.expand(*batch, -1, -1))
    return torch.cat(parts, -2)
