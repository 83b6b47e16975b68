"""How likely it is that a hand's centre lies in each cell of a person's window."""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose.errors import check_shape
from torchpose.measure.body_window import CELL, CELLS, EVIDENCE, cell_centres

__all__ = ["HandLikelihood"]


class HandLikelihood(nn.Module):
    """Log likelihood of a hand at every cell, from skin, motion, and the shape of a hand.

        l(x) = a D(x) + c S(x) + m M(x) + u U(x)
             - b S(x - 0.9 e) + t S(x + 0.65 e) - s (S(x - 0.55 n) + S(x + 0.55 n))

    D, M and U are the means of skin, motion and the unusual over a hand, S that of skin over a palm; e
    is the unit vector towards the elbow that the pose prior expects, n the one across. A hand has the
    forearm on one side and nothing of skin beyond its fingers; a point on a bare forearm has skin on
    both. What lies outside of the image is skin with a fixed probability, so that neither a hand at
    the border nor the lack of one is invented there.

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
        self.register_buffer("cues", torch.tensor([core, disc, motion, unusual]))
        weights = [-beyond, towards, -beside, -beside]
        offsets = [
            [-beyond_at, 0.0],
            [towards_at, 0.0],
            [0.0, -beside_at],
            [0.0, beside_at],
        ]
        used = [i for i, weight in enumerate(weights) if weight]
        self.register_buffer("shape_weights", torch.tensor([weights[i] for i in used]))
        self.register_buffer(
            "shape_offsets", torch.tensor([offsets[i] for i in used]).reshape(-1, 2)
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

    def means(self, maps: Float[Tensor, "N 3 h w"]) -> Float[Tensor, "N 4 r c"]:
        """Means about the centre of every cell: skin over a palm, then all three over a hand.

        Args:
            maps: skin, motion and the unusual, per pixel of evidence. Beyond the window its border
                counts.
        """
        for _ in range(EVIDENCE // 2):
            maps = maps[..., ::2, :] + maps[..., 1::2, :]
            maps = (maps[..., ::2] + maps[..., 1::2]) / 4
        palm = self.palm_rows @ maps[:, :1] @ self.palm_columns.T
        return torch.cat([palm, self.hand_rows @ maps @ self.hand_columns.T], 1)

    def forward(
        self, means: Float[Tensor, "N 4 r c"], elbow: Float[Tensor, "N 2 2 r c"]
    ) -> Float[Tensor, "N 2 r c"]:
        """Log likelihood for the left and the right hand, up to a constant.

        Args:
            means: see `means`.
            elbow: (x, y) of the expected elbow of each arm, in B from the anchor.
        """
        check_shape("means", means, ["N", 4, *CELLS])
        common = torch.tensordot(self.cues, means.movedim(1, 0), 1)[:, None]
        if not len(self.shape_weights):
            return common.expand(-1, 2, -1, -1)
        places, middle, half = _grid()
        to_elbow = elbow.movedim(2, -1) - places
        along = to_elbow / (to_elbow.square().sum(-1, keepdim=True).sqrt_() + 1e-3)
        across = along.flip(-1) * along.new_tensor([-1.0, 1.0])
        along, across = along / half, across / half
        start = (places - middle) / half
        a, b = (self.shape_offsets[:, i].view(-1, 1, 1, 1) for i in (0, 1))
        grid = start + a * along[:, :, None] + b * across[:, :, None]
        n, hands, points = grid.shape[:3]
        found = nn.functional.grid_sample(
            means[:, :1] - self.unknown, grid.flatten(1, 3), align_corners=False
        ).view(n, hands, points, -1)
        found = torch.einsum("p,nkpc->nkc", self.shape_weights, found + self.unknown)
        return common + found.view(n, hands, *CELLS)


@cache
def _grid() -> tuple[Tensor, Tensor, Tensor]:
    """Return the places of the cells, the middle of the window, and half its width and height, in B."""
    places = cell_centres()
    half = (places[-1, -1] - places[0, 0] + CELL) / 2
    return places, (places[-1, -1] + places[0, 0]) / 2, half


def _palm_matrix(cells: int, palm: float) -> Tensor:
    """Means over `palm` about the middle of each cell."""
    centre = (torch.arange(cells)[:, None] + 0.5) * CELL
    edge = torch.arange(cells + 1) * CELL
    edge[0], edge[-1] = -palm, edge[-1] + palm  # the border counts for what is beyond it
    part = edge[None].clamp(min=centre - palm / 2, max=centre + palm / 2).diff(dim=1)
    return part / part.sum(1, keepdim=True)


def _hand_matrix(cells: int, hand: float) -> Tensor:
    """The same over a hand: flat over half of it, falling off to both sides."""
    return sum(  # type: ignore[return-value]
        _palm_matrix(cells, hand * (0.5 + (i + 0.5) / n)) / n for n in (8,) for i in range(n)
    )
