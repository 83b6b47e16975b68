"""Model short windows of motion: an arm's state together with where hands were seen around it.

A window state is the 21 numbers of the arm followed by pixels (u, v) of hands: of the arm's own hand
some frames earlier (or later), and of the other hand. A mixture over windows carries motion and the
other arm into the estimate, which a mixture over single poses cannot.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from torchpose._core.module_state import index_tensor
from torchpose.camera._projection import project
from torchpose.camera._viewpoints import Viewpoints
from torchpose.camera._virtual_camera import BodyPath
from torchpose.errors import PriorError
from torchpose.math._rotations import euler_to_matrix
from torchpose.priors._arm_state import STATE_DIM, check_rotation_order, mirror_arm_state
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.skeleton._torso import in_torso_axes
from torchpose.skeleton._upper_body import LEFT_ARM, RIGHT_ARM, mirror_pose, scale_bones

_HANDS = {"left": (0, 7), "right": (7, 0)}  # own hand, other hand
_TORSO_DIM = 15
_SEEN = (0, 1, 9, 10, 12, 13)  # pixels of hand, head and neck
_ARMS = {"left": LEFT_ARM, "right": RIGHT_ARM}
_SAME_BONE = (0, 1, 2, 3, 1, 2, 3)  # left and right limbs are of one length


@dataclass(frozen=True)
class WindowLayout:
    """Lags of the hands that a window holds.

    Attributes:
        own: lags of the arm's own hand, frames; positive is the past. other: lags of the other hand.
        fps: the frame rate that the lags count at.
        torso: whether the joints of the arm in the axes of the torso follow (`torchpose.skeleton._torso`).
        repeated: which of the hands, own before other, are not measured because their frame is that of a
            nearer lag, or for the own hand the present one. At low rates several lags are one frame, which
            counts once.
    """

    own: tuple[int, ...]
    other: tuple[int, ...]
    fps: float = 30.0
    torso: bool = False
    repeated: tuple[int, ...] = ()

    @property
    def dim(self) -> int:
        """Return the number of dimensions of a window state."""
        return STATE_DIM + 2 * self.n_hands + (_TORSO_DIM if self.torso else 0)

    @property
    def n_hands(self) -> int:
        """Return the number of hands of other frames and of the other arm."""
        return len(self.own) + len(self.other)

    @property
    def hands(self) -> range:
        """Return the dimensions of a window state that are pixels of hands."""
        return range(STATE_DIM, STATE_DIM + 2 * self.n_hands)

    @property
    def deciding(self) -> list[int]:
        """Return the dimensions that decide a window's component (`torchpose.learning._streamed_em`).

        What is measured, and with `torso` what is wanted of it; without, all of them.
        """
        if not self.torso:
            return list(range(self.dim))
        return [*_SEEN, *self.hands, *self.in_torso]

    @property
    def in_torso(self) -> range:
        """Return the dimensions of a window state that are joints in the axes of the torso."""
        return range(self.hands.stop, self.dim)

    @property
    def lags(self) -> tuple[int, ...]:
        """Return all lags, with 0, in order."""
        return tuple(sorted({0, *self.own, *self.other}))

    @property
    def ahead(self) -> int:
        """Return the number of later frames that a window needs."""
        return max(0, -min((*self.own, *self.other), default=0))

    def at_rate(self, fps: float) -> "WindowLayout":
        """Return the lags in frames at another frame rate."""
        ratio = fps / self.fps
        exact = [[lag * ratio for lag in lags] for lags in (self.own, self.other)]
        own, other = (tuple(round(lag) for lag in lags) for lags in exact)
        of_own, of_other = _repeated(exact[0], {0}), _repeated(exact[1], set())
        repeated = (*of_own, *(len(own) + i for i in of_other))
        return WindowLayout(own, other, fps, self.torso, repeated)


def _repeated(lags: Sequence[float], taken: set[int]) -> list[int]:
    """Return which lags are rounded to a frame that is taken, or to which another one is nearer.

    Of two that are as near the first is measured.
    """
    off = [round(abs(lag - round(lag)), 6) for lag in lags]
    nearest_first = sorted(range(len(lags)), key=off.__getitem__)
    repeated = []
    for i in nearest_first:
        frame = round(lags[i])
        if frame in taken:
            repeated.append(i)
        taken = taken | {frame}
    return sorted(repeated)


class WindowPrior(nn.Module):
    """Mixtures over window states of both arms, with the settings of the filter that uses them.

    Args:
        left, right: mixtures over `layout.dim` dimensions. layout: the hands in a window.
        settings: numbers by name: hand_std (pixels, of the window's hands), likelihood_power, and
            joint_ratio, pixel_ratio and placement_ratio (1/s^3, of
            `torchpose.upper_body._fusion.MotionStage`).

    Raises:
        PriorError: mixtures of another size.
    """

    def __init__(
        self,
        left: GaussianMixture,
        right: GaussianMixture,
        layout: WindowLayout,
        settings: Mapping[str, float],
    ) -> None:
        super().__init__()
        for side, mixture in (("left", left), ("right", right)):
            if mixture.dim != layout.dim:
                raise PriorError(
                    f"the {side} window mixture must be over {layout.dim} dimensions for "
                    f"{layout}, got {mixture.dim}"
                )
        self.left, self.right = left, right
        self.layout = layout
        self.settings = dict(settings)

    def facts(self) -> dict[str, Any]:
        """Return the facts that a prior file stores about the windows, as JSON values."""
        layout: dict[str, Any] = {"own": list(self.layout.own), "other": list(self.layout.other)}
        layout |= {"fps": self.layout.fps, "torso": self.layout.torso}
        return layout | {"settings": self.settings}

    @classmethod
    def from_facts(
        cls, left: GaussianMixture, right: GaussianMixture, facts: Mapping[str, Any]
    ) -> "WindowPrior":
        """Return the windows of mixtures and `facts`."""
        own, other = tuple(facts["own"]), tuple(facts["other"])
        layout = WindowLayout(own, other, facts["fps"], bool(facts.get("torso", False)))
        return cls(left, right, layout, facts["settings"])

    def mirrored(self, cx: float) -> "WindowPrior":
        """Return windows of the mirrored person: each arm is the mirror image of the other one."""
        left, right = (_mirror(mixture, cx, self.layout) for mixture in (self.right, self.left))
        return WindowPrior(left, right, self.layout, self.settings)


def _mirror(mixture: GaussianMixture, cx: float, layout: WindowLayout) -> GaussianMixture:
    extra, joints = 2 * layout.n_hands, len(layout.in_torso) // 3
    base = mirror_arm_state(mixture.means[:, :STATE_DIM], cx)
    flip = mixture.means.new_tensor([-1.0, 1.0]).repeat(extra // 2)
    shift = mixture.means.new_tensor([2 * cx, 0.0]).repeat(extra // 2)
    flip = torch.cat([flip, flip.new_tensor([-1.0, 1.0, 1.0]).repeat(joints)])
    shift = torch.cat([shift, shift.new_zeros(3 * joints)])
    means = torch.cat([base, mixture.means[:, STATE_DIM:] * flip + shift], 1)
    sign = torch.cat([mirror_arm_state(torch.ones_like(base[0]), 0.0), flip])
    return GaussianMixture(mixture.weights, means, mixture.covariances * sign * sign[:, None])


def augment_bodies(
    joints: Float[Tensor, "N W 8 3"],
    generator: torch.Generator,
    size: float,
    bones: float,
) -> Float[Tensor, "N W 8 3"]:
    """Return windows of other body sizes: all bones times one factor, and each by one of its own.

    Args:
        joints: centred on the neck. size, bones: largest relative change, uniform; left and right
            limbs stay of one length, and all frames of a window keep their body.
    """
    n = len(joints)

    def draw(count: int, limit: float) -> Tensor:
        return 1 + limit * (2 * torch.rand(n, count, generator=generator, dtype=joints.dtype) - 1)

    factors = draw(4, bones)[:, list(_SAME_BONE)] * draw(1, size)
    return scale_bones(joints, factors[:, None])


def mirror_bodies(
    joints: Float[Tensor, "N W 8 3"], generator: torch.Generator, share: float
) -> Float[Tensor, "N W 8 3"]:
    """Return windows of which a random share is mirrored: left and right change places."""
    mirrored = torch.rand(len(joints), generator=generator) < share
    return torch.where(mirrored[:, None, None, None], mirror_pose(joints), joints)


def window_state(
    joints: Float[Tensor, "N W 8 3"],
    views: Viewpoints,
    layout: WindowLayout,
    side: str,
    matrix: Float[Tensor, "3 3"],
    rotation_order: str,
) -> Float[Tensor, "N D"]:
    """Return window states of one arm: the arm, the camera, hands at their lags, the arm on its torso.

    Args:
        joints: poses at `layout.lags`, centred on the neck, metres. views: a camera pose for each
            window. layout: the hands of a window. side: "left" or "right". matrix: K, without skew.
        rotation_order: "zxy" (paper) or "zyx" (released priors).
    """
    order = check_rotation_order(rotation_order)
    rotation = euler_to_matrix(views.angles, order)[:, None]
    place = views.translation[:, None]
    at = {lag: i for i, lag in enumerate(layout.lags)}
    own, other = _HANDS[side]
    arm = project(joints[:, at[0] : at[0] + 1, list(_ARMS[side])], matrix, rotation, place)
    parts = [arm.flatten(1), views.angles, views.translation]
    for joint, lags in ((own, layout.own), (other, layout.other)):
        if lags:
            hands = joints[:, [at[lag] for lag in lags], joint]
            parts.append(project(hands, matrix, rotation[:, 0], place[:, 0])[..., :2].flatten(1))
    if layout.torso:
        parts.append(in_torso_axes(joints[:, at[0]])[:, list(_ARMS[side])].flatten(1))
    return torch.cat(parts, 1)


def window_measurements(
    uv: Float[Tensor, "B T 8 2"],
    mask: Bool[Tensor, "B T 8"],
    layout: WindowLayout,
    sides: Sequence[str],
    path: BodyPath,
    start: int = 0,
) -> tuple[Float[Tensor, "B S H 2"], Bool[Tensor, "B S H"]]:
    """Return the measured pixels of the hands of each frame's window, relative to the body's present place.

    Poses of the prior are centred on the neck and seen from one place, so a hand of another frame is
    carried along with the body (`BodyPath.carried`). A hand that was not measured, that lies
    beyond the ends of the sequence or that the window has already (`WindowLayout.repeated`) is missing.

    Args:
        uv, mask: the eight joints in the prior's pixels. layout: lags in frames of this sequence.
        sides: whose windows, of "left" and "right". path: of the body, at the lags of the layout.
        start: first frame that is wanted, as in `body_path`.

    Returns:
        Pixels [B, S, H, 2] and mask [B, S, H] of S = T - start frames and the H own and other hands of each
        side, in the order of the window state.
    """
    lags, joints = len(sides) * (*layout.own, *layout.other), []
    for own, other in (_HANDS[side] for side in sides):
        joints += [own] * len(layout.own) + [other] * len(layout.other)
    n_frames = uv.shape[1]
    back = index_tensor(lags, uv.device)
    frames = torch.arange(start, n_frames, device=uv.device)[:, None] - back
    inside = (frames >= 0) & (frames < n_frames)
    once = [i % layout.n_hands not in layout.repeated for i in range(len(lags))]
    if not all(once):
        inside = inside & index_tensor(tuple(once), uv.device).bool()
    frames, rows = frames.clamp(0, n_frames - 1), index_tensor(tuple(joints), uv.device)
    return path.carried(uv[:, frames, rows], lags), mask[:, frames, rows] & inside
