"""Estimate poses from windows of motion: each frame with the hands shortly before and after it.

Mixtures over windows see the body through a virtual camera that follows it
(`torchpose.camera._virtual_camera`).
"""

from functools import cache
from itertools import chain
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchpose._core.module_state import derived, index_tensor, outside_inference
from torchpose.camera._virtual_camera import memory_frames, planes_in_view
from torchpose.errors import InputError
from torchpose.filters._fixed_tracks import FixedTrackFilter
from torchpose.filters._measurements import Measurements, check_lengths
from torchpose.filters._memoryless import Wanted, run_with_context
from torchpose.filters._outputs import FilterOutput
from torchpose.filters._outside_points import OutsidePoint, with_outside_point
from torchpose.filters._side_by_side import SideBySide
from torchpose.math._gaussian import block_diagonal, point_blocks
from torchpose.math._geometric_median import median_columns
from torchpose.math._rotations import matrix_to_euler
from torchpose.priors._arm_state import STATE_DIM
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.priors._window import WindowPrior
from torchpose.skeleton._upper_body import ARM_JOINTS
from torchpose.upper_body._absence import Absence
from torchpose.upper_body._estimator import (
    ARMS,
    ArmGenerators,
    ArmJoints,
    Estimates,
    Estimator,
    MotionRatios,
    TrackerModel,
    in_double,
    repeat_last,
    require_cov,
)
from torchpose.upper_body._measured_joints import (
    CAMERA_ANGLES,
    MeasuredJoints,
    pixel_indices,
    upright_cov,
)
from torchpose.upper_body._window_view import SeenInView, see_in_view, suitable_window

_N_LIMB = 2  # hand and elbow, the first of an arm, which may be before or behind the body
_LIMBS = ARM_JOINTS[:_N_LIMB]


class WindowState(NamedTuple):
    """State of `WindowMixture` between two frames.

    Attributes:
        recent: the eight joints of the last frames, at most N, in the prior's pixels, the latest last,
            with R of each frame [B, N, 8, 2, 2], or of all [8, 2, 2].
        joints: the joints that each arm's filter measures.
    """

    recent: MeasuredJoints
    joints: ArmJoints


class WindowMixture(Estimator):
    """Estimator that conditions the prior's mixture over windows on each frame and the hands near it.

    The motion stage follows, since the noise of keypoints and the change from one component to the
    next show as jitter.

    Args:
        model: the model of the tracker; its prior has a window that suits (`suitable_window`).
        likelihood_power: exponent of the likelihood in the weights; by default that of the window.
        dtype: the floating-point type of means and measurements; covariances are always float64.

    Attributes:
        of_limbs: whether `FilterOutput.log_evidence` is that of elbow and hand alone, given the torso.

    Raises:
        InputError: no window suits.
    """

    smooths = True
    reads_rays = True
    of_limbs = False

    def __init__(
        self,
        model: TrackerModel,
        likelihood_power: float | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        found = suitable_window(model.prior, model.smoothing, model.rate)
        if found is None:
            raise InputError("the prior has no mixture over windows that suits the smoothing")
        self.model, self.dtype = model, dtype
        self.calibration, self.layout = found
        self.window = model.prior.windows[self.calibration]
        self.ahead = self.layout.ahead
        settings = self.window.settings
        self.power = settings["likelihood_power"] if likelihood_power is None else likelihood_power
        if "joint_ratio" in settings:  # how brisk the motions were that the prior learnt
            self.steadied_by = MotionRatios(
                *(settings[f"{kind}_ratio"] for kind in MotionRatios._fields)
            )

    def check(self) -> None:
        """Make the filters of hand, head and neck, whose options are checked."""
        for side in ARMS:
            self._filter(side, ("head", "neck", "hand"))

    def init(
        self, batch_size: int, joints: ArmJoints, arm_generators: ArmGenerators
    ) -> WindowState:
        """Return the state before the first frame; see `Estimator`."""
        like = self.model.measurement_cov
        recent = MeasuredJoints(
            like.new_zeros(batch_size, 0, 8, 2),
            torch.zeros(batch_size, 0, 8, dtype=torch.bool, device=like.device),
            like.new_zeros(batch_size, 0, 8, 2, 2),
        )
        return WindowState(recent, joints)

    @property
    def _n_recent(self) -> int:
        return 1 + memory_frames(self.layout.lags, self.layout.fps)

    def advance(
        self, state: WindowState, measured: MeasuredJoints, progress: bool = False
    ) -> tuple[WindowState, Estimates]:
        """Return the next state and the estimates of T more frames; see `Estimator`."""
        frames = _append(state.recent, measured)
        seen = self._see(frames, None, -measured.uv.shape[1])
        seen = seen._replace(measured=seen.measured._replace(cov=measured.cov))
        estimates = self._estimate(seen, state.joints, None, progress, measured.absence)
        return WindowState(_last(frames, self._n_recent), state.joints), estimates

    def forward(
        self,
        measured: MeasuredJoints,
        joints: ArmJoints,
        arm_generators: ArmGenerators,
        lengths: Tensor | None = None,
        progress: bool = False,
    ) -> Estimates:
        """Return the estimates of whole sequences; see `Estimator`."""
        if self.model.smoothing is None:
            return super().forward(measured, joints, arm_generators, lengths, progress)
        seen = self._see(measured, lengths, 0)
        found = self._estimate(seen, joints, lengths, progress, measured.absence)
        return repeat_last(found, lengths)

    def _see(self, measured: MeasuredJoints, lengths: Tensor | None, start: int) -> SeenInView:
        model = self.model
        return see_in_view(
            measured, model.prior, self.layout, model.measurement_cov, lengths, start
        )

    def _estimate(
        self,
        seen: SeenInView,
        joints: ArmJoints,
        lengths: Tensor | None = None,
        progress: bool = False,
        absence: Absence | None = None,
    ) -> Estimates:
        """Return the estimates of frames; their evidence is that of each frame given its window."""
        (batch, n_frames), device = seen.measured.uv.shape[:2], seen.measured.uv.device
        lengths, arms, contexts = check_lengths(lengths, batch, n_frames, device), [], []
        measured = {side: _limbs_last(joints[side]) for side in ARMS}
        points = {side: self._outside(seen, absence, side) for side in ARMS}
        # of many frames with gaps, fewer have the same gaps in the windows of both arms
        both = n_frames == 1 and len({*measured.values()}) == 1 and not any(points.values())
        for sides in [tuple(ARMS)] if both else [(side,) for side in ARMS]:
            own, point = measured[sides[0]], points[sides[0]]
            model = self._filters(sides, own)
            frames = self._frames(model, seen, sides, own, lengths)
            out, context = self._filtered(model, frames, sides[0], own, point, progress)
            arms += _split_filters(in_double(out), batch)
            contexts += context.split(batch)
        told = tuple(arm[:_N_LIMB] if self.of_limbs else arm for arm in ARMS.values())
        left, right = _beyond_context(arms, contexts, seen, told)
        return Estimates(left, right, seen.view)

    def _filtered(
        self,
        model: SideBySide,
        frames: Measurements,
        side: str,
        joints: tuple[str, ...],
        point: OutsidePoint | None,
        progress: bool,
    ) -> tuple[FilterOutput, Tensor]:
        """Return the estimates of arms, and the evidence of what they are told beside (`_context`).

        They are of the arm of this frame, followed by its joints in the axes of the torso.

        Args:
            model, frames: the filters and what they measure. side: the first arm. joints: of this frame.
            point: the evidence that the hand of a single arm is outside of the image.
        """
        columns = (*range(STATE_DIM), *self.layout.in_torso)
        wanted = Wanted(columns, self._context(joints), self.layout.torso)
        first, rule, given = self._filter(side, joints), model.weight_rule, (frames, True)
        medians = first.medians
        if point is None:
            points = _limbs_in_torso(medians.device)[: len(medians)]
            out, context = run_with_context(model, rule, points, *given, wanted, progress)
        else:
            whole, points = Wanted(None, wanted.n_context), median_columns(medians)
            out, context = run_with_context(model, rule, points, *given, whole, progress)
            out = with_outside_point(first, out, frames.of_filter(0), point)
            kept = torch.tensor(columns, device=medians.device)
            cov = require_cov(out)[..., kept[:, None], kept]
            cov = point_blocks(cov) if wanted.of_points else cov
            out = out._replace(mean=out.mean[..., kept], cov=cov)
        return out, torch.zeros_like(out.log_evidence) if context is None else context

    def _context(self, joints: tuple[str, ...]) -> int:
        """Return how many of the first measurements are the window's hands, and the torso if it is given."""
        torso = [joint for joint in joints if joint not in _LIMBS] if self.of_limbs else []
        return 2 * (self.window.layout.n_hands + len(torso) + self.model.upright)

    def _outside(self, seen: SeenInView, absence: Absence | None, side: str) -> OutsidePoint | None:
        """Return the evidence that an arm's hand is outside of the image, if there is any in these frames."""
        if absence is None:
            return None
        known = seen.measured.mask[:, :, ARMS[side][0]]
        log_inside = absence.log_inside[..., list(ARMS).index(side)].masked_fill(known, 0.0)
        if not bool((log_inside < 0).any()):
            return None
        matrix = self.model.prior.info.matrix.to(absence.planes)
        planes = planes_in_view(absence.planes, seen.view, matrix)
        return OutsidePoint(torch.arange(2, device=planes.device), planes, log_inside)

    def _frames(
        self,
        model: SideBySide,
        seen: SeenInView,
        sides: tuple[str, ...],
        joints: tuple[str, ...],
        lengths: Int[Tensor, " B"],
    ) -> Measurements:
        """Return the hands of the window and some joints of arms, which were checked as keypoints."""
        cov = self.model.measurement_cov
        noise = _window_noise(seen, self.window, sides, joints, cov) if joints else None
        z, mask = _window_inputs(seen, sides, joints)
        if self.model.upright:
            # roll and pitch of the virtual camera are known, and bodies of the prior are upright
            angles = matrix_to_euler(seen.view.rotation, "zxy")[..., :2]
            z = torch.cat([angles.expand(len(sides), -1, -1, -1), z], -1)
            mask = torch.nn.functional.pad(mask, (2, 0), value=True)
            if noise is not None:
                spread = upright_cov().to(noise)
                noise = _blocks(spread.expand(*noise.shape[:-2], 2, 2), noise)
        z = torch.where(mask, z, 0.0).to(model.dtype)
        lengths = lengths.expand(len(sides), -1)
        return Measurements(z, mask, model.noise if noise is None else noise, lengths)

    def _filters(self, sides: tuple[str, ...], joints: tuple[str, ...]) -> SideBySide:
        """Return the filters of arms side by side; made once for their prior, noise and settings."""
        mixtures = [getattr(self.window, side).parameters_tuple() for side in sides]
        sources = (*chain.from_iterable(mixtures), self.model.measurement_cov)
        return derived(
            self.model.owner,
            self._name(sides, joints),
            sources,
            lambda: self._side_by_side(sides, joints),
        )

    def _side_by_side(self, sides: tuple[str, ...], joints: tuple[str, ...]) -> SideBySide:
        filters = [self._filter(side, joints) for side in sides]
        return SideBySide(filters, [own.weight_rule for own in filters])

    def _name(self, sides: tuple[str, ...] | str, joints: tuple[str, ...]) -> tuple[Any, ...]:
        """Return the name that filters of these settings are kept by."""
        settings = (*self.window.settings.items(), self.power, self.dtype, self.model.upright)
        return self.calibration, sides, joints, self.window.layout, *settings

    def _filter(self, side: str, joints: tuple[str, ...]) -> FixedTrackFilter:
        """Return the filter of an arm; made once for its prior, noise and settings."""
        window, cov, upright = self.window, self.model.measurement_cov, self.model.upright
        mixture: GaussianMixture = getattr(window, side)
        return derived(
            self.model.owner,
            self._name(side, joints),
            (*mixture.parameters_tuple(), cov),
            lambda: _window_filter(window, side, joints, cov, self.power, self.dtype, upright),
        )


def _append(frames: MeasuredJoints, new: MeasuredJoints) -> MeasuredJoints:
    """Return the last frames, and the new ones after them; before the first frame the new ones alone.

    R is that of each joint in each frame, or [8, 2, 2] where it is the same one in all of them.
    """
    if frames.uv.shape[1] == 0:
        return MeasuredJoints(*new[:3])
    uv, mask = (
        torch.cat([old, latest], 1) for old, latest in zip(frames[:2], new[:2], strict=True)
    )
    if new.cov is frames.cov:
        return MeasuredJoints(uv, mask, new.cov)
    covs = torch.cat([frames.cov_of_frames, new.cov_of_frames], 1)
    return MeasuredJoints(uv, mask, covs)


def _last(frames: MeasuredJoints, count: int) -> MeasuredJoints:
    """Return the last frames, at most `count`."""
    cov = frames.cov if frames.cov.ndim == 3 else frames.cov[:, -count:]
    return MeasuredJoints(frames.uv[:, -count:], frames.mask[:, -count:], cov)


def _window_filter(
    window: WindowPrior,
    side: str,
    joints: tuple[str, ...],
    measurement_cov: Float[Tensor, "8 2 2"],
    likelihood_power: float,
    dtype: torch.dtype,
    upright: bool,
) -> FixedTrackFilter:
    """Return the filter of fixed tracks over windows that measures a window's hands and these joints.

    Before them it measures roll and pitch of the camera, if these are known.
    """
    layout = window.layout
    blocks = [upright_cov().to(measurement_cov)] if upright else []
    blocks += [_hand_cov(window, side, measurement_cov)] * layout.n_hands
    blocks += [*measurement_cov[list(_rows(side, joints))]]
    # Poses of consecutive frames are tied by the window itself: no memory beyond it.
    return FixedTrackFilter(
        getattr(window, side),
        torch.ones(layout.dim, dtype=torch.float64),
        torch.block_diag(*blocks),
        [*(CAMERA_ANGLES if upright else ()), *layout.hands, *pixel_indices(joints)],
        transition="ou",
        gamma=0.0,
        weighting="frame",
        medians=layout.in_torso[: 3 * _N_LIMB : 3] if joints else (),
        likelihood_power=likelihood_power,
        dtype=dtype,
    )


def _hand_cov(window: WindowPrior, side: str, measurement_cov: Tensor) -> Tensor:
    """Return R of a hand of the window: that of a hand of this frame, and the spread that moving it adds."""
    own = measurement_cov[ARMS[side][0]]
    return own + window.settings["hand_std"] ** 2 * torch.eye(2, dtype=own.dtype, device=own.device)


def _window_inputs(
    seen: SeenInView, sides: tuple[str, ...], joints: tuple[str, ...]
) -> tuple[Float[Tensor, "A B T Z"], Bool[Tensor, "A B T Z"]]:
    """Return values and mask of the hands of the window, and of some joints of arms."""
    rows = index_tensor(_rows_of_arms(sides, joints), seen.measured.uv.device)
    first = list(ARMS).index(sides[0])
    arms = slice(first, first + len(sides))
    parts = zip(seen.hands, (seen.measured.uv, seen.measured.mask), strict=True)
    z, mask = (
        torch.cat([hands[:, :, arms], own.index_select(2, rows).unflatten(2, (len(sides), -1))], 3)
        for hands, own in parts
    )
    return z.flatten(-2).movedim(2, 0), mask.repeat_interleave(2, -1).movedim(2, 0)


def _window_noise(
    seen: SeenInView,
    window: WindowPrior,
    sides: tuple[str, ...],
    joints: tuple[str, ...],
    measurement_cov: Float[Tensor, "8 2 2"],
) -> Tensor | None:
    """Return R of `_window_inputs`; None where it is that of the filter."""
    if seen.measured.cov is measurement_cov:
        return None
    rows = index_tensor(_rows_of_arms(sides, joints), seen.measured.cov.device)
    own = seen.measured.cov.index_select(-3, rows).unflatten(-3, (len(sides), -1))
    hands = torch.stack([_hand_cov(window, side, measurement_cov) for side in sides])[:, None]
    hands = hands.expand(*own.shape[:-3], window.layout.n_hands, 2, 2)
    return block_diagonal(torch.cat([hands, own], -3)).movedim(-3, 0)


def _blocks(first: Float[Tensor, "*batch N N"], last: Float[Tensor, "*batch M M"]) -> Tensor:
    """Return matrices with two blocks on their diagonals."""
    n, m = first.shape[-1], last.shape[-1]
    return torch.nn.functional.pad(first, (0, m, 0, m)) + torch.nn.functional.pad(
        last, (n, 0, n, 0)
    )


def _limbs_last(joints: tuple[str, ...]) -> tuple[str, ...]:
    """Return joints in an order in which the torso comes before hand and elbow."""
    return tuple(sorted(joints, key=lambda joint: joint in _LIMBS))


@cache
def _limbs_in_torso(device: torch.device) -> Int[Tensor, "P 3"]:
    """Return the dimensions of hand and elbow in the axes of the torso, after the arm itself."""
    with outside_inference():
        return STATE_DIM + torch.arange(3 * _N_LIMB, device=device).view(_N_LIMB, 3)


def _rows(side: str, joints: tuple[str, ...]) -> tuple[int, ...]:
    """Return which of the eight joints these of an arm are."""
    return tuple(ARMS[side][ARM_JOINTS.index(joint)] for joint in joints)


def _rows_of_arms(sides: tuple[str, ...], joints: tuple[str, ...]) -> tuple[int, ...]:
    """Return which of the eight joints these of some arms are, arm by arm."""
    return tuple(row for side in sides for row in _rows(side, joints))


def _split_filters(out: FilterOutput, batch_size: int) -> list[FilterOutput]:
    """Return the estimates of each of some filters that ran side by side."""
    parts = ([None] * (len(out.mean) // batch_size) if value is None else value.split(batch_size)
             for value in out)  # fmt: skip
    return [FilterOutput(*values) for values in zip(*parts, strict=True)]


def _beyond_context(
    arms: list[FilterOutput],
    contexts: list[Float[Tensor, "B T"]],
    seen: SeenInView,
    told: tuple[tuple[int, ...], ...],
) -> list[FilterOutput]:
    """Return the estimates of both arms, with their evidence beyond that of the context.

    The evidence is a density over pixels of the prior's camera, not of the virtual one.

    Args:
        arms, contexts: the estimates, and the log-evidence of the context. seen: what they are told.
        told: the joints of each arm whose evidence it is.
    """
    rows = index_tensor(sum(told, ()), seen.log_scale.device)
    known, scale = (
        values.index_select(2, rows).unflatten(2, (len(told), -1))
        for values in (seen.measured.mask, seen.log_scale)
    )
    evidence = torch.stack([arm.log_evidence for arm in arms], -1) - torch.stack(contexts, -1)
    evidence = torch.where(known.any(-1), evidence + (scale * known).sum(-1), 0.0)
    pairs = zip(arms, evidence.unbind(-1), strict=True)
    return [arm._replace(log_evidence=own) for arm, own in pairs]
