"""Model how limbs stand to each other and how fast they turn, learnt from recorded bodies.

A limb conditional is a Gaussian over the rotation q_ij = q_i^-1 q_j from a part i to the part j that
hangs on it; temporal diffusion is one over the rotation of a part from one frame to the next. Both
are what `torchpose.math._tree_messages` passes messages with.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchpose._core.checks import (
    check_choice,
    check_finite,
    check_flat_covariance,
    check_rate,
    check_shape,
    check_tensors,
)
from torchpose._core.module_state import NoHalfModule, derived, register_given
from torchpose._core.moved import moved_function
from torchpose._core.reading import reading
from torchpose._core.tensor_file import FileKind, read_tensors, write_tensors
from torchpose.body._kinematics import Body, centres_of
from torchpose.errors import FileFormatError, InputError, PriorError
from torchpose.math._rotation_gaussians import (
    left_matrix,
    quaternion_moments,
    right_matrix,
    sigma_quaternions,
    turn_gaussian,
)
from torchpose.math._rotations import compose, conjugate, vector_to_quaternion
from torchpose.math._tree_messages import message_tree
from torchpose.math._unscented import DIRECTIONS, Directions

_SIDES = ("left", "right")
PART_TREE: tuple[tuple[str, str], ...] = (
    ("torso", "head"),
    *(("torso", f"{side}_upper_arm") for side in _SIDES),
    *(("torso", f"{side}_thigh") for side in _SIDES),
    *((f"{side}_upper_arm", f"{side}_forearm") for side in _SIDES),
    *((f"{side}_thigh", f"{side}_shank") for side in _SIDES),
)
"""Parts above and below of every edge (DX, Figure 2); the root sends no messages, it conditions all."""

_DIRECTIONS = "sigma_point_directions"  # in `LimbInfo.extra` of a file, where they are not "eigen"
_SAME_CENTRE = 1e-6  # difference of quaternion vectors that count as the same


@dataclass(frozen=True)
class LimbInfo:
    """Holds facts about the fit of limb conditionals; fields that are not known are empty.

    Attributes:
        name: the name of the conditionals.
        parts: names of all parts of the skeleton, the root first.
        fps: frames per second that the diffusion is for. fitted_fps: of the recordings.
        n_frames: that they were fitted on.
        persons: ids of the persons. actions: what they did. sources: recordings or data sets.
        licence: the licence of the data. command: that made it.
        extra: anything else that JSON can hold.
    """

    name: str = ""
    parts: tuple[str, ...] = ()
    fps: float = 60.0
    fitted_fps: float = 60.0
    n_frames: int = 0
    persons: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    licence: str = ""
    command: str = ""
    extra: dict[str, Any] = field(default_factory=dict)


LEAST_STD = 0.01
"""Least deviation of a fitted limb: 1.1 degrees, about what joints tell of a rotation."""

_KIND = FileKind(
    "torchpose-limb-conditionals",
    1,
    LimbInfo,
    tensors={
        "mean": "E 3", "covariance": "E 3 3", "edge_centres": "E 3", "centres": "P 3",
        "diffusion": "P 3 3", "growth": "P",
    },
    indices={"edges": "E 2"},
    covariances=("covariance", "diffusion"),
)  # fmt: skip


class _Products(NamedTuple):
    """Products of quaternions, for messages along every edge; see `LimbConditionals._make_products`."""

    predict: Tensor
    carry: Tensor


class LimbConditionals(NoHalfModule):
    """Holds Gaussians over the rotations between connected parts, and over those from frame to frame.

    p(x_j | x_i, c_ij) ~ F(q_i, N(x_ij; mu_ij, Sigma_ij)),   q_ij = q_i^-1 q_j               (DX 3)
    p(x_j^{t+1} | x_j^t) ~ F(mu_j^t, N(0, Sigma'_j)),        q' = (q_j^t)^-1 q_j^{t+1}       (DX 14)

    q_i is the rotation of part i against the root part, as in a `Body` with ``frame="body"``; x_i is
    its vector in the space around that body's centre of the part (a state's columns), and x_ij that
    of q_ij around a centre of its own, the safe one of its training rotations (DX 1).

    Nodes of `tree` are the parts without the root: node n is part n + 1, in the order of a state's
    columns.

    Args:
        info: facts about the fit.
        edges: [E, 2], indices of the parts above and below.
        mean, covariance: mu_ij [E, 3] and Sigma_ij [E, 3, 3].
        edge_centres: [E, 3], centres of the q_ij. centres: [P, 3], of the body's parts.
        diffusion: Sigma'_j per frame, [P, 3, 3], the root part's orientation in the world first.
        growth: g_j [P], by which it grows with the time t between frames as t^g: 1 for a random walk,
            as by default, 2 for limbs that swing on.
        directions: the directions of sigma points, see `sigma_points`.

    Attributes:
        info: as given. tree: a `MessageTree` over the P - 1 parts that are not the root.

    Buffers: edges, mean, covariance, edge_centres, centres, diffusion, growth, as above.

    Raises:
        SkeletonError: edges with a cycle, an unknown part or a part with two above it. PriorError: an
            edge of the root. ShapeError: sizes that do not go together. InputError: unknown directions.
            CovarianceError: what is no covariance.

    Reference: Daubney & Xie, sections 4 and 7.
    """

    edges: Tensor
    mean: Tensor
    covariance: Tensor
    edge_centres: Tensor
    centres: Tensor
    diffusion: Tensor
    growth: Tensor

    def __init__(
        self,
        info: LimbInfo,
        edges: Int[Tensor, "E 2"],
        mean: Float[Tensor, "E 3"],
        covariance: Float[Tensor, "E 3 3"],
        edge_centres: Float[Tensor, "E 3"],
        centres: Float[Tensor, "P 3"],
        diffusion: Float[Tensor, "P 3 3"],
        growth: Float[Tensor, " P"] | None = None,
        directions: Directions = "eigen",
    ) -> None:
        super().__init__()
        n_parts, n_edges = len(info.parts), edges.shape[0]
        check_choice("directions", directions, DIRECTIONS)
        check_shape("edges", edges, [None, 2])
        if bool(((edges < 0) | (edges >= n_parts)).any()):
            raise PriorError(
                f"edges must be between the {n_parts} parts of `info`, got {edges.tolist()!s:.120}"
            )
        if bool((edges == 0).any()):
            raise PriorError(
                f"the root part {info.parts[0]!r} conditions all others and has no edges; leave it "
                "out of the tree"
            )
        self.info, self.directions = info, directions
        self.tree = message_tree(edges.long() - 1, n_parts - 1)  # without the root
        register_given(self, "edges", edges)
        growth = torch.ones_like(diffusion[:, 0, 0]) if growth is None else growth
        for name, value, sizes in (
            ("mean", mean, [n_edges, 3]),
            ("covariance", covariance, [n_edges, 3, 3]),
            ("edge_centres", edge_centres, [n_edges, 3]),
            ("centres", centres, [n_parts, 3]),
            ("diffusion", diffusion, [n_parts, 3, 3]),
            ("growth", growth, [n_parts]),
        ):
            check_shape(name, value, sizes)
            check_finite(name, value)
            if name in _KIND.covariances:
                check_flat_covariance(name, value)
            register_given(self, name, value)

    fit = staticmethod(
        moved_function("LimbConditionals.fit", "torchpose.learning.fit_limb_conditionals")
    )

    # --- messages -----------------------------------------------------------------------------

    def transport(
        self,
        mean: Float[Tensor, "*batch El 3"],
        covariance: Float[Tensor, "*batch El 3 3"],
        edges: Int[Tensor, " El"],
        upward: bool,
    ) -> tuple[Float[Tensor, "*batch El 3"], Float[Tensor, "*batch El 3 3"]]:
        """Return messages along edges: what the part at one end says about the part at the other.

        N(mu_j, Sigma_j) = F(mu_i, N(mu_ij, Sigma_ij))   (DX 9)
        N(., Sigma_j^err) = F(N(mu_i, Sigma_i), mu_ij)   (DX 10)
        N(mu_j, Sigma_j + Sigma_j^err)                   (DX 11)

        and upwards the same with q_i = q_j q_ij^-1.

        Args:
            mean, covariance: of the parts that send, in the spaces of their centres.
            edges: which ones. upward: from the part below to the part above.

        Returns:
            Mean and covariance about the parts that receive, in the spaces of their centres.
        """
        predict, carry = self._predict[int(upward)], self._carry[int(upward)]
        sent = vector_to_quaternion(mean)
        predicted = torch.einsum("ekc,...ec->...ek", predict[edges], sent).unflatten(-1, (7, 4))
        points = sigma_quaternions(mean, covariance, self.directions)
        carried = torch.einsum("...esc,ekc->...esk", points, carry[edges])
        new_mean, spread = quaternion_moments(predicted)
        return new_mean, spread + quaternion_moments(carried)[1]

    def diffuse(
        self,
        mean: Float[Tensor, "*batch V 3"],
        covariance: Float[Tensor, "*batch V 3 3"],
    ) -> tuple[Float[Tensor, "*batch V 3"], Float[Tensor, "*batch V 3 3"]]:
        """Return the parts one frame later: the same mean, and a covariance inflated by the diffusion.

        N(x^{t+1}; mu^t, Sigma^t + Sigma^diff),   N(., Sigma^diff) = F(mu^t, N(0, Sigma'))   (DX 13-14)

        Args:
            mean, covariance: of the P - 1 parts that are not the root, [..., P - 1, 3] and
                [..., P - 1, 3, 3], in the spaces of their centres.
        """
        check_shape("mean", mean, ["...", self.tree.n_nodes, 3])
        step = self.diffusion[1:]
        _, spread = turn_gaussian(
            torch.zeros_like(self.centres[1:]), step, left=mean, directions=self.directions
        )
        return mean, covariance + spread

    # --- rates, bodies and files --------------------------------------------------------------

    def at_rate(self, fps: float, growth: float | None = None) -> "LimbConditionals":
        """Return the same conditionals with the diffusion per frame of another frame rate, `info.fps`.

        Sigma'_j(fps) = Sigma'_j (fps_0 / fps)^{g_j}

        Args:
            fps: frames per second.
            growth: g of all parts, such as 1 for a random walk; those learnt by default.

        Raises:
            InputError: a rate that is not positive.
        """
        check_rate("fps", fps)
        tensors = {name: value.clone() for name, value in self._tensors().items()}
        exponent = tensors["growth"] if growth is None else torch.full_like(self.growth, growth)
        tensors["diffusion"] *= ((self.info.fps / fps) ** exponent)[:, None, None]
        info = replace(self.info, fps=float(fps))
        return LimbConditionals(info, **tensors, directions=self.directions)

    def check_for(self, body: Body) -> None:
        """Raise `PriorError` unless they are of the parts, frame and centres of a body."""
        check_body_frame(body)
        found = []
        if tuple(body.skeleton.parts) != self.info.parts:
            found.append(f"they are of the parts {', '.join(self.info.parts)}")
        elif bool(((body.centres - self.centres.to(body.centres)).abs() > _SAME_CENTRE).any()):
            found.append("their parts are centred elsewhere")
        if found:
            raise PriorError(
                f"the limb conditionals {self.info.name!r} are of another body: {'; '.join(found)}; "
                "give the body their centres with Body.altered(frame='body', centres=...centres)"
            )

    def save(self, path: str | Path) -> None:
        """Write them as safetensors; the file appears whole or not at all."""
        info = self.info
        if self.directions != "eigen":
            info = replace(info, extra=info.extra | {_DIRECTIONS: self.directions})
        write_tensors(path, _KIND, info, self._tensors())

    @classmethod
    def load(cls, path: str | Path) -> "LimbConditionals":
        """Read a file of `save`, in double precision.

        Raises:
            InputError: no such file. FileFormatError: truncated or of another kind.
        """
        info, tensors = read_tensors(path, _KIND)
        edges = tensors.pop("edges")
        plain = {name: value.double() for name, value in tensors.items()}
        extra = dict(info.extra)
        directions = extra.pop(_DIRECTIONS, "eigen")
        if directions not in DIRECTIONS:
            raise FileFormatError(
                f"{path}: {_DIRECTIONS} must be one of {', '.join(DIRECTIONS)}, got {directions!r:.60}"
            )
        with reading(path, "limb conditionals"):
            return cls(replace(info, extra=extra), edges, **plain, directions=directions)

    def extra_repr(self) -> str:
        rescaled = self.info.fps != self.info.fitted_fps
        source = f", rescaled from {self.info.fitted_fps:g}" if rescaled else ""
        edges = f"{len(self.edges)} edges of {len(self.info.parts)} parts"
        return f"{self.info.name!r}, {edges}, {self.info.fps:g} frames per second{source}"

    def _tensors(self) -> dict[str, Tensor]:
        return {name: self.get_buffer(name) for name in (*_KIND.tensors, *_KIND.indices)}

    @property
    def _predict(self) -> Tensor:
        return self._products().predict

    @property
    def _carry(self) -> Tensor:
        return self._products().carry

    def _products(self) -> "_Products":
        sources = (self.edges, self.mean, self.covariance, self.edge_centres, self.centres)
        return derived(self, "products", sources, self._make_products)

    def _make_products(self) -> "_Products":
        """Return products of quaternions that all messages along an edge share, down and up.

        Down, C_j R(x_j) = C_i R(x_i) C_ij R(x_ij) is linear in the quaternion of x_i for each sigma
        point of x_ij (`_predict`), and in that of every sigma point of x_i for the mean of x_ij
        (`_carry`); up, the same with C_i R(x_i) = C_j R(x_j) R(-x_ij) C_ij^-1.
        """
        above, below = self.edges.long().unbind(-1)
        between = compose(conjugate(self.centres[below]), self.centres[above])
        points = sigma_quaternions(self.mean, self.covariance, self.directions)
        turns = points @ left_matrix(vector_to_quaternion(self.edge_centres)).mT  # q_ij [E, 7, 4]
        inverse = torch.tensor([-1.0, -1.0, -1.0, 1.0]).to(turns)
        first = left_matrix(torch.stack([q := vector_to_quaternion(between), q * inverse]))
        second = right_matrix(torch.stack([turns, turns * inverse]))
        predict = (first[:, :, None] @ second).flatten(2, 3)
        return _Products(predict, first @ second[:, :, 0])


def in_body_frame(
    persons: Sequence[tuple[Body, Sequence[Tensor]]],
) -> tuple[Body, list[Tensor]]:
    """Return recorded states of several persons as states of one body with safe centres (DX 1).

    Args:
        persons: every one's body, of any frame and centres, and their sequences of states [T, D].

    Returns:
        The first person's body with ``frame="body"`` and centres learnt from all sequences; the
        sequences, in their order, as its states. Another person's body joins them by
        ``other.altered(frame="body", centres=body.centres)``.

    Raises:
        InputError: nobody, or no states. ShapeError: states that are not [T, D]. SkeletonError: bodies of
            different skeletons.
    """
    if not persons or not any(len(states) for _, several in persons for states in several):
        raise InputError("expected recorded states of at least one person, got none")
    for own, several in persons:
        for states in several:
            check_tensors(states=states)
            check_shape("states", states, ["T", own.dim])
    plain = persons[0][0].altered(frame="body", centres=torch.zeros_like(persons[0][0].centres))
    sequences = [own.convert(states, plain) for own, several in persons for states in several]
    body = plain.altered(centres=centres_of(plain, torch.cat(sequences)))
    return body, [plain.convert(states, body) for states in sequences]


def check_body_frame(body: Body) -> None:
    """Raise `PriorError` unless states of a body are relative to its root part."""
    if body.frame != "body":
        raise PriorError(
            f"limb conditionals are of states with frame='body', got a body with {body.frame!r}; "
            "bring body and states into it with in_body_frame"
        )
