"""Estimate single poses by a recursive filter of each arm, with the noise that the prior brings."""

import inspect
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Float
from torch import Tensor

from torchpose._core.module_state import derived
from torchpose.camera._tilt import Turn, up_of_angles
from torchpose.camera._virtual_camera import BodyView
from torchpose.errors import DegenerateFilterWarning, InputError
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._recursive_filter import RecursiveFilter
from torchpose.priors._arm_state import STATE_DIM
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.priors._upper_body_prior import UpperBodyPrior, released_process_cov
from torchpose.skeleton._upper_body import ARM_JOINTS
from torchpose.upper_body._estimator import (
    ARMS,
    ArmGenerators,
    ArmJoints,
    Estimates,
    Estimator,
    TrackerModel,
    in_double,
    require_cov,
)
from torchpose.upper_body._measured_joints import (
    CAMERA_ANGLES,
    MeasuredJoints,
    arm_measurements,
    pixel_indices,
    upright_cov,
)

_WALK_RATE = 0.9  # of a component's covariance, per second; chosen as the methods' factors were


class ProcessNoise(NamedTuple):
    """Computes Q of a method from the recorded steps that a prior brings.

    With S the second moment of the recorded steps (`increment_covs`) and k the factor, Q = k S for a
    walk, which has to step where the prior has bodies, and Q = k diag(S) for the others, whose
    transition brings them back there.

    Attributes:
        factor: k; that of a method has the least error on training persons that were held out
            (`benchmarks/process_noise.py`).
        walks: whether the method walks at random.
        tuned: whether a Q that the prior states comes first, as fine-tuning states it.
    """

    factor: float = 10.0
    walks: bool = False
    tuned: bool = True

    def cov(
        self, prior: UpperBodyPrior, side: str
    ) -> Float[Tensor, "21 21"] | Float[Tensor, " 21"]:
        """Return Q per frame at the prior's own rate.

        A prior without S has the Q that it states, else `default_process_cov`; walks then have
        `default_walk_cov`.

        Args:
            prior: the prior that brings the noise. side: "left" or "right".

        Returns:
            Q [21, 21], or its diagonal [21], in squares of pixels, metres and radians.
        """
        noise = prior.noise
        stated = noise.get(f"process_cov_{side}", noise.get("process_cov"))
        increments = noise.get(f"increment_cov_{side}")
        if self.walks:
            return default_walk_cov(prior, side) if increments is None else self.factor * increments
        if stated is not None and (increments is None or self.tuned):
            return stated
        if increments is None:
            return default_process_cov(prior)
        return self.factor * increments.diagonal()


def default_process_cov(prior: UpperBodyPrior) -> Float[Tensor, " 21"]:
    """Return the diagonal of Q per frame where a prior brings none: that of the released tracker.

    Its authors set it by hand for f = 1550 pixels, a person 4.5 m away and 25 frames per second; the
    same movement in metres is f / depth times as many pixels elsewhere.

    Args:
        prior: the prior; its camera, mean depth and frame rate are used.
    """
    depth = prior.left.moments()[0][2:15:3].mean().clamp_min(0.1)
    pixels = math.sqrt(prior.info.fx * prior.info.fy) / depth / (1550 / 4.5)
    released = released_process_cov().to(pixels)
    in_pixels = torch.zeros(STATE_DIM, dtype=torch.bool, device=released.device)
    in_pixels[pixel_indices(ARM_JOINTS)] = True
    scaled = torch.where(in_pixels, released * pixels.square(), released)
    return scaled * (25.0 / (prior.info.fps or 30.0))


def default_walk_cov(prior: UpperBodyPrior, side: str) -> Float[Tensor, "21 21"]:
    """Return Q per frame for particles that walk at random, where a prior brings no recorded steps.

    Q = r / fps sum_i pi_i Sigma_i, r = 0.9 / s: a step in the directions in which a component is wide.
    The released Q lets every number wander by itself, up to a metre of depth in a frame, which leaves
    hardly any particle where the prior has bodies.

    Args:
        prior: the prior; its mixture and frame rate are used. side: "left" or "right".
    """
    mixture = getattr(prior, side)
    within = torch.einsum("k,kij->ij", mixture.weights, mixture.covariances)
    return _WALK_RATE / (prior.info.fps or 30.0) * within


_GIVEN = ("measurement_cov", "observed")  # by the tracker, beside the mixture


@dataclass(frozen=True)
class PoseFilter:
    """Makes an estimator of the tracker from a filter over single poses, when it is called.

    Args:
        filter: makes the filter of an arm from its mixture, `measurement_cov`, `observed` and
            options; a `RecursiveFilter`. If it has a `process_cov`, that is the prior's by default.
        settings: arguments that make it this method, and are no options of it.
        defaults: the defaults of options, in place of the filter's own.
        noise: how the process noise follows from what the prior brings.
        brought: which of the options "transition", "gamma" and "uniform_weight" the prior sets.
        smooths, particles: as in `Estimator`.

    Example:
        >>> from torchpose.filters import MixtureKalmanFilter
        >>> from torchpose.upper_body._single_poses import PoseFilter
        >>> one = PoseFilter(MixtureKalmanFilter, {"tracks": "split"})
        >>> "n_tracks" in one.options, "tracks" in one.options
        (True, False)
    """

    filter: Callable[..., RecursiveFilter]
    settings: Mapping[str, Any] = field(default_factory=dict)
    defaults: Mapping[str, Any] = field(default_factory=dict)
    noise: ProcessNoise = field(default_factory=ProcessNoise)
    brought: tuple[str, ...] = ()
    smooths: bool = False
    particles: bool = False

    @property
    def options(self) -> tuple[str, ...]:
        """Return the names of the method's options, by the signature of its filter."""
        names = [*inspect.signature(self.filter).parameters][1:]  # without the mixture
        taken = {*_GIVEN, *self.settings}
        return tuple(name for name in names if name not in taken)

    def __call__(self, model: TrackerModel, **options: Any) -> "SinglePoses":
        """Return the estimator of a tracker.

        Args:
            model: the model of the tracker. options: some of `options`.
        """
        return SinglePoses(model, self, options)

    def arguments(
        self,
        prior: UpperBodyPrior,
        side: str,
        fps: float | None,
        options: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Return the caller's options, and for the others the noise and transition of the prior.

        Args:
            prior: the prior, whose noise is scaled to the frame rate, and left out where an option of the
                caller has no use for it. side: "left" or "right". fps: frames per second. options: the
                options of the caller.

        Returns:
            Keyword arguments of the filter.

        Raises:
            InputError: process_cov for the transition "ou", which has no Q.
        """
        own = dict(options or {})
        brought = self._brought(prior, side, fps)
        kind = own.get("transition", brought.get("transition"))
        if kind == "ou" and "process_cov" in own:
            raise InputError(
                "process_cov does not apply to transition 'ou', whose noise is gamma's"
            )
        if kind != "ou":
            brought.pop("gamma", None)
        if own.get("weighting") == "frame":
            brought.pop("uniform_weight", None)
        return brought | own

    def _brought(self, prior: UpperBodyPrior, side: str, fps: float | None) -> dict[str, Any]:
        noise, info = prior.noise, prior.info
        ratio = 1.0 if not fps or not info.fps else info.fps / fps
        options = dict(self.defaults)
        if "process_cov" in self.options:
            options["process_cov"] = ratio * self.noise.cov(prior, side)
        gamma = noise.get(f"gamma_{side}", noise.get("gamma"))
        epsilon = noise.get("uniform_weight")
        learnt = {
            "transition": info.transition,
            "gamma": None if gamma is None else gamma**ratio,
            "uniform_weight": None if epsilon is None else float(epsilon),
        }
        known = {name: learnt[name] for name in self.brought if learnt[name] is not None}
        return options | known


class PoseState(NamedTuple):
    """States of the filters of both arms, by "left" and "right", with their joints and generators.

    Attributes:
        filters: the state of each arm's filter. joints: the joints that each arm's filter measures.
        generators: the random generators of each arm.
    """

    filters: dict[str, Any]
    joints: ArmJoints
    generators: ArmGenerators


class SinglePoses(Estimator):
    """Estimator that follows single poses with a recursive filter of each arm.

    Args:
        model: the model of the tracker. method: the filter, and what it takes from the prior.
        options: the options of the method that the caller gave.
    """

    def __init__(self, model: TrackerModel, method: PoseFilter, options: Mapping[str, Any]) -> None:
        self.model, self.method, self.options = model, method, dict(options)

    def filter(self, side: str, joints: tuple[str, ...]) -> RecursiveFilter:
        """Return the filter of an arm that measures these joints; made once for its prior, noise and options.

        Args:
            side: "left" or "right". joints: some of `ARM_JOINTS`.
        """
        prior, cov = self.model.prior, self.model.measurement_cov
        tensors = [value for value in self.options.values() if isinstance(value, Tensor)]
        mixture: GaussianMixture = getattr(prior, side)
        info = prior.info
        return derived(
            self.model.owner,
            (side, joints, info.fps, info.transition, info.fx, info.fy, self.model.upright),
            (*mixture.parameters_tuple(), *prior.noise.values(), cov, *tensors),
            lambda: self._make(side, joints),
        )

    def _make(self, side: str, joints: tuple[str, ...]) -> RecursiveFilter:
        prior, arm = self.model.prior, ARMS[side]
        cov = self.model.measurement_cov
        blocks = [cov[arm[ARM_JOINTS.index(joint)]] for joint in joints]
        observed = pixel_indices(joints)
        if self.model.upright:
            blocks, observed = [*blocks, upright_cov().to(cov)], [*observed, *CAMERA_ANGLES]
        return self.method.filter(
            getattr(prior, side),
            measurement_cov=torch.block_diag(*blocks),
            observed=observed,
            **self.method.settings,
            **self.method.arguments(prior, side, self.model.fps, self.options),
        )

    def check(self) -> None:
        """Make the filters of hand, head and neck, whose options are checked."""
        for side in ARMS:
            self.filter(side, ("hand", "head", "neck"))

    def init(self, batch_size: int, joints: ArmJoints, arm_generators: ArmGenerators) -> PoseState:
        """Return the state before the first frame; see `Estimator`."""
        filters = {
            side: self.filter(side, joints[side]).init(batch_size, generator=arm_generators[side])
            for side in ARMS
        }
        return PoseState(filters, joints, arm_generators)

    def advance(
        self, state: PoseState, measured: MeasuredJoints, progress: bool = False
    ) -> tuple[PoseState, Estimates]:
        """Return the next state and the estimates of T more frames; see `Estimator`."""
        filters, arms = {}, {}
        measured, view = self._see(measured)
        for side, arm in ARMS.items():
            joints = state.joints[side]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DegenerateFilterWarning)  # told by `failed`
                filters[side], out = self.filter(side, joints).advance(
                    state.filters[side],
                    *self._measured_by(arm, joints, measured),
                    generator=state.generators[side],
                    return_cov=True,
                    progress=progress,
                )
            arms[side] = in_double(out._replace(cov=require_cov(out)))
        return state._replace(filters=filters), Estimates(arms["left"], arms["right"], view)

    def forward(
        self,
        measured: MeasuredJoints,
        joints: ArmJoints,
        arm_generators: ArmGenerators,
        lengths: Tensor | None = None,
        progress: bool = False,
    ) -> Estimates:
        """Return the estimates of whole sequences; see `Estimator`.

        `RecursiveFilter.forward` is `init` and `advance` of the filter, and knows which of its
        covariances the sequences share. Smoothing takes all frames at once and shows no bar.
        """
        smoothing, arms = self.model.smoothing, {}
        measured, view = self._see(measured)
        for side, arm in ARMS.items():
            model = self.filter(side, joints[side])
            z, mask, cov = self._measured_by(arm, joints[side], measured)
            if smoothing is None:
                own = arm_generators[side]
                out = model(
                    z, mask, cov, generator=own, lengths=lengths, return_cov=True, progress=progress
                )
            else:
                lag = None if smoothing == "full" else int(smoothing)
                smooth = cast(MixtureKalmanFilter, model).smooth  # or another filter that smooths
                out = smooth(z, mask, cov, lengths=lengths, lag=lag, return_cov=True)
            arms[side] = in_double(out)
        return Estimates(arms["left"], arms["right"], view)

    def _see(self, measured: MeasuredJoints) -> tuple[MeasuredJoints, BodyView | None]:
        """Return measurements as the camera has them but for its roll, where bodies are as in the prior.

        In the level camera a body that is seen from above is far below the prior's bodies.
        """
        if not self.model.upright:
            return measured, None
        matrix = self.model.prior.info.matrix.to(measured.uv)
        up = matrix.new_tensor(up_of_angles(self.model.pitch or 0.0))
        turn = Turn.to_level(up, matrix).back(matrix)
        uv, cov = turn.points(measured.uv), turn.covariances(measured.cov, measured.uv)
        there = measured.mask[..., None]
        uv = torch.where(there, uv, torch.zeros_like(uv))
        cov = torch.where(there[..., None], cov, self.model.measurement_cov)
        ones = torch.ones_like(uv[..., 0, 0])
        rotation = turn.rotation.expand(*ones.shape, 3, 3)
        return measured._replace(uv=uv, cov=cov), BodyView(
            rotation, ones, torch.zeros_like(uv[..., 0, :])
        )

    def _measured_by(
        self, arm: tuple[int, ...], joints: tuple[str, ...], measured: MeasuredJoints
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return what an arm's filter measures: its joints, then roll and pitch of the camera if known."""
        z, mask, cov = arm_measurements(arm, joints, measured)
        if not self.model.upright:
            return z, mask, cov
        angles = torch.zeros_like(z[..., :2])
        angles[..., 1] = -(self.model.pitch or 0.0)  # about the axis to the right, which looks down
        n = cov.shape[-1]
        noise = torch.nn.functional.pad(upright_cov().to(cov), (n, 0, n, 0))
        return (
            torch.cat([z, angles], -1),
            torch.cat([mask, torch.ones_like(mask[..., :2])], -1),
            torch.nn.functional.pad(cov, (0, 2, 0, 2)) + noise,
        )
