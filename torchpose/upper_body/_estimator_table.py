"""List the methods of the upper-body tracker by name, and choose the one that runs."""

import inspect
import warnings
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from torchpose._core.checks import check_choice, refuse_unused
from torchpose._core.registry import add_method
from torchpose.errors import InputError
from torchpose.filters._fixed_tracks import FixedTrackFilter
from torchpose.filters._mkf import MixtureKalmanFilter
from torchpose.filters._particle import BootstrapParticleFilter
from torchpose.filters._sampled_tracks import SampledTrackFilter
from torchpose.filters._split_tracks import SplitTrackFilter
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._estimator import Estimator
from torchpose.upper_body._lifted_articulated import LiftedArticulatedFilter
from torchpose.upper_body._multiple_models import MultipleModelFilter
from torchpose.upper_body._single_poses import PoseFilter, ProcessNoise
from torchpose.upper_body._window_view import suitable_window
from torchpose.upper_body._windows import WindowMixture

WINDOWS = "window-mixture"
"""The mixture over short windows of motion, in each of which every frame is estimated anew."""

SINGLE_POSES = "mkf-fixed"
"""The bank of Kalman filters over single poses."""

BONES = "articulated"
"""Arms of bones that keep their lengths, averaged with lifted ones."""

_BOTH = "multiple-model"

Method = type[Estimator] | PoseFilter
"""What makes an estimator from a `TrackerModel` and, by name, the options in its signature."""


def _kalman_bank(
    kind: type[MixtureKalmanFilter], factor: float, brought: tuple[str, ...]
) -> PoseFilter:
    fixed = kind is FixedTrackFilter
    settings = {"medians": ()} if fixed else {}
    return PoseFilter(kind, settings, noise=ProcessNoise(factor), brought=brought, smooths=fixed)


def _particles(proposal: str, noise: ProcessNoise) -> PoseFilter:
    settings, defaults = {"proposal": proposal}, {"start": "measured"}
    return PoseFilter(BootstrapParticleFilter, settings, defaults, noise=noise, particles=True)


METHODS: dict[str, Method] = {
    WINDOWS: WindowMixture,
    BONES: LiftedArticulatedFilter,
    _BOTH: MultipleModelFilter,
    SINGLE_POSES: _kalman_bank(FixedTrackFilter, 100.0, ("transition", "gamma", "uniform_weight")),
    "mkf-sampled": _kalman_bank(SampledTrackFilter, 10.0, ("transition", "gamma")),
    "mkf-split": _kalman_bank(SplitTrackFilter, 10.0, ("transition", "gamma")),
    "pf-mixture": _particles("mixture", ProcessNoise(10.0, tuned=False)),
    "pf-walk": _particles("random-walk", ProcessNoise(1.0, walks=True)),
    "pf-walk-unscaled": _particles("random-walk-unscaled", ProcessNoise(1.0, walks=True)),
}
"""Every method by its name: `UpperBodyTracker`, the command line and the benchmarks take them from here."""

# Without a method these options mean single poses, as they did before windows had a name.
_POSE_OPTIONS = {"transition", "gamma", "subspace", "initial_cov", "process_cov"}


def register_method(name: str, method: Method) -> None:
    """Add a method, which `UpperBodyTracker`, the command line and the benchmarks then know.

    Args:
        name: a new one. method: a subclass of `Estimator`, or a filter over single poses as a
            `PoseFilter`; its options are those of its signature.

    Raises:
        InputError: another method has this name, or it is no method.
    """
    estimator = isinstance(method, type) and issubclass(method, Estimator)
    if not (estimator or isinstance(method, PoseFilter)):
        raise InputError(
            f"a method must be a subclass of Estimator or a PoseFilter, got {method!r:.80}; "
            "docs/adding-a-tracker.md shows both"
        )
    add_method(METHODS, name, method)


def method_options(method: str) -> tuple[str, ...]:
    """Return the options of a method: the arguments of what makes its estimator.

    Args:
        method: one of `METHODS`.

    Returns:
        Names of the options.

    Raises:
        InputError: no such method.

    >>> method_options("window-mixture")
    ('likelihood_power', 'dtype')
    >>> "n_tracks" in method_options("mkf-split"), "n_tracks" in method_options("mkf-fixed")
    (True, False)
    """
    made_by = _find(method)
    if isinstance(made_by, PoseFilter):
        return made_by.options
    return tuple(inspect.signature(made_by).parameters)[1:]  # without the model


def process_cov(prior: UpperBodyPrior, side: str, method: str) -> Tensor:
    """Return Q of a method, per frame at the prior's own rate; see `ProcessNoise`.

    Args:
        prior: the prior that brings the noise. side: "left" or "right". method: one over single poses.

    Raises:
        InputError: no such method, or one that has no process noise.
    """
    return _find_filter(method).noise.cov(prior, side)


def noise_options(prior: UpperBodyPrior, side: str, method: str) -> dict[str, Any]:
    """Return the noise and transition that a prior brings for a method over single poses, at its own rate.

    Args:
        prior, side: as in `PoseFilter.arguments`. method: one over single poses.

    Raises:
        InputError: as `process_cov`.
    """
    return _find_filter(method).arguments(prior, side, None)


def check_options(method: str, options: Iterable[str]) -> None:
    """Refuse options that a method does not use, and say which method does.

    Raises:
        InputError: such an option.
    """
    said = f"does not apply to method {method!r}"
    refuse_unused(options, said, method, METHODS, method_options)


def check_steady(steady: bool | None, estimator: Estimator, method: str) -> bool:
    """Return whether the poses of an estimator pass the motion stage.

    Args:
        steady: as in `UpperBodyTracker`; None is wherever the estimator has ratios for it.
        estimator: the estimator of the method. method: the name of the method.

    Raises:
        InputError: steady without ratios.
    """
    able = estimator.steadied_by is not None
    if steady and not able:
        raise InputError(
            f"steady=True needs method {WINDOWS!r} and a prior that says how brisk its motions "
            f"are, got method {method!r}; leave it out"
        )
    return able if steady is None else steady


class Chosen(NamedTuple):
    """Choice of a method.

    Attributes:
        method: one of `METHODS`. notes: about the choice, in plain words.
        free: whether the method follows from the joints: the caller named none, nor an option of one.
    """

    method: str
    notes: tuple[str, ...]
    free: bool = False

    def with_joints(self, there: Sequence[bool], wrists: bool) -> str:
        """Return the method for these joints: "articulated" where wrists stand for the prior's hands.

        Other methods take one for the other. It is "articulated" also where both shoulders and an elbow are
        measured and the prior has no windows that suit.

        Args:
            there: whether each of `UPPER_BODY` is measured. wrists: whether wrists are measured in place
                of the prior's hands.
        """
        seen = {name for name, known in zip(UPPER_BODY, there, strict=True) if known}
        whole = {"shoulder_left", "shoulder_right"} <= seen
        bent = not seen.isdisjoint({"elbow_left", "elbow_right"})
        bones = wrists or (self.method != _BOTH and whole and bent)
        return BONES if self.free and bones else self.method


def choose_method(
    prior: UpperBodyPrior,
    method: str | None,
    smoothing: int | str | None,
    fps: float | None,
    options: Iterable[str],
    windows: bool = False,
) -> Chosen:
    """Return the method that was named, else one with windows where the prior's suit, else single poses.

    Args:
        prior: with its windows. method: one of `METHODS`, or None. smoothing, fps: as in
            `suitable_window`. options: names of those that were given to the filter.
        windows: whether something was asked for that is of windows alone.

    Raises:
        InputError: no such method, one that cannot do what was asked for, an option that it does not
            use, or a smoothing that is none.
    """
    lag = isinstance(smoothing, int) and not isinstance(smoothing, bool) and smoothing >= 0
    if not (smoothing is None or lag or smoothing == "full"):
        raise InputError(f"smoothing must be None, a number of frames or 'full', got {smoothing!r}")
    free = method is None and not windows and not list(options)
    chosen = Chosen(method, ()) if method else _default(prior, smoothing, fps, options, free)
    if smoothing is not None and not _find(chosen.method).smooths:
        able = [repr(name) for name, other in METHODS.items() if other.smooths]
        raise InputError(f"smoothing needs method {' or '.join(able)}, got {chosen.method!r}")
    if method in (WINDOWS, _BOTH) and suitable_window(prior, smoothing, fps or 30.0) is None:
        raise InputError(
            f"method {method!r} cannot be used: {_missing(prior, smoothing, fps)}; use method "
            f"{SINGLE_POSES!r}"
        )
    check_options(chosen.method, options)
    return chosen._replace(free=free)


def _find(method: str) -> Method:
    check_choice("method", method, METHODS)
    return METHODS[method]


def _find_filter(method: str) -> PoseFilter:
    found = _find(method)
    if not isinstance(found, PoseFilter):
        raise InputError(f"method {method!r} has no process noise: it follows no single poses")
    return found


def _default(
    prior: UpperBodyPrior,
    smoothing: int | str | None,
    fps: float | None,
    options: Iterable[str],
    free: bool,
) -> Chosen:
    """Return the choice of a method where none was named."""
    if set(method_options(BONES)) & set(options):  # of no other method
        return Chosen(BONES, ())
    poses = sorted(_POSE_OPTIONS & set(options))
    if poses:
        warnings.warn(
            f"{', '.join(poses)} without a method is deprecated: pass method={SINGLE_POSES!r}, which "
            "is what runs",
            DeprecationWarning,
            stacklevel=4,
        )
        return Chosen(SINGLE_POSES, ())
    if suitable_window(prior, smoothing, fps or 30.0) is not None:
        return Chosen(_BOTH if free else WINDOWS, ())
    if not prior.windows:
        return Chosen(SINGLE_POSES, ())
    reason = _missing(prior, smoothing, fps)
    return Chosen(SINGLE_POSES, (f"single poses are tracked ({SINGLE_POSES}), since {reason}",))


def _missing(prior: UpperBodyPrior, smoothing: int | str | None, fps: float | None) -> str:
    """Return the reason for which no window of the prior suits, for a note or an error."""
    name = "causal" if smoothing is None else "full"
    if name not in prior.windows:
        use = "filtering" if smoothing is None else "smoothing"
        return f"the prior brings no mixtures over windows for {use}"
    ahead = prior.windows[name].layout.at_rate(fps or 30.0).ahead
    return f"the prior's windows look {ahead} frames ahead, and smoothing may use {smoothing}"


def replace_window(
    method: str | None, window: bool, steady: bool | None
) -> tuple[str | None, bool | None]:
    """Return the method and `steady` that the deprecated argument `window` stands for.

    "mkf-fixed" stood for both, windows unless `window` was False; other methods took `window` and
    `steady` and did without.

    Raises:
        InputError: "window-mixture" with window=False.
    """
    if method == WINDOWS and not window:
        raise InputError(f"method {WINDOWS!r} and window=False contradict each other")
    if method in (None, SINGLE_POSES):
        method = None if window else SINGLE_POSES
    return method, None if steady else steady


def options_of_window(
    method: str | None, window: bool, steady: bool | None
) -> tuple[str | None, bool | None]:
    """Return `replace_window`, with a `DeprecationWarning` for the caller of the tracker."""
    warnings.warn(
        f"window={window} is deprecated: method={WINDOWS!r} follows windows of motion, "
        f"{SINGLE_POSES!r} single poses, and without a method the tracker chooses",
        DeprecationWarning,
        stacklevel=3,
    )
    return replace_window(method, window, steady)
