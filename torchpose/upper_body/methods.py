"""The estimators of the upper body by name: which one runs, and which options it has."""

import inspect
import warnings
from collections.abc import Callable, Iterable
from typing import NamedTuple

from torchpose.errors import InputError
from torchpose.filters.base import RecursiveFilter
from torchpose.filters.mkf import TRACK_OPTIONS, MixtureKalmanFilter
from torchpose.filters.particle import BootstrapParticleFilter
from torchpose.priors.upper_body import UpperBodyPrior
from torchpose.upper_body.windows import WINDOW_OPTIONS, suitable_window

__all__ = [
    "METHODS",
    "SINGLE_POSES",
    "SMOOTHABLE",
    "WINDOWS",
    "Chosen",
    "check_options",
    "choose_method",
    "method_options",
    "options_of_before",
    "pose_model",
]

WINDOWS = "window-mixture"
"""The mixture over short windows of motion, in each of which every frame is estimated anew."""

SINGLE_POSES = "mkf-fixed"
"""The bank of Kalman filters over single poses."""

_PARTICLES = {
    "pf-mixture": "mixture",
    "pf-walk": "random-walk",
    "pf-walk-unscaled": "random-walk-unscaled",
}
METHODS = (WINDOWS, SINGLE_POSES, "mkf-sampled", "mkf-split", *_PARTICLES)
SMOOTHABLE = (WINDOWS, SINGLE_POSES)
# What the tracker gives to a filter by itself.
_GIVEN = {"self", "gmm", "measurement_cov", "observed", "tracks", "proposal", "medians"}
# Without a method these options mean single poses, as they did before windows had a name.
_POSE_OPTIONS = {"transition", "gamma", "subspace", "initial_cov", "process_cov"}


class Chosen(NamedTuple):
    """The estimator that runs, and what is to be said about the choice."""

    method: str
    notes: tuple[str, ...]


def pose_model(method: str) -> tuple[Callable[..., RecursiveFilter], dict[str, str]]:
    """Return the class of a filter over single poses, and the argument that makes it this method."""
    if method in _PARTICLES:
        return BootstrapParticleFilter, {"proposal": _PARTICLES[method]}
    return MixtureKalmanFilter, {"tracks": method.removeprefix("mkf-")}


def method_options(method: str) -> tuple[str, ...]:
    """Return the options of the filter that a method uses.

    Args:
        method: one of `METHODS`.

    Raises:
        InputError: no such method.

    >>> method_options("window-mixture")
    ('likelihood_power', 'dtype')
    >>> "n_tracks" in method_options("mkf-split"), "n_tracks" in method_options("mkf-fixed")
    (True, False)
    """
    _check_method(method)
    if method == WINDOWS:
        return WINDOW_OPTIONS
    model, kind = pose_model(method)
    names = [name for name in inspect.signature(model).parameters if name not in _GIVEN]
    unused = {n for n, tracks in TRACK_OPTIONS.items() if kind.get("tracks", tracks) not in tracks}
    return tuple(name for name in names if name not in unused)


def check_options(method: str, options: Iterable[str]) -> None:
    """Refuse options that a method does not use, and say which method does.

    Raises:
        InputError: such an option.
    """
    own = method_options(method)
    for name in options:
        if name in own:
            continue
        others = [other for other in METHODS if name in method_options(other)]
        raise InputError(
            f"option {name!r} does not apply to method {method!r}, which has "
            f"{', '.join(own)}; "
            + (f"it is of {', '.join(others)}" if others else "it is of no method")
        )


def choose_method(
    prior: UpperBodyPrior,
    method: str | None,
    smoothing: int | str | None,
    fps: float | None,
    options: Iterable[str],
) -> Chosen:
    """Choose the estimator: the one that was named, else windows where the prior's suit.

    Args:
        prior: with its windows. method: one of `METHODS`, or None. smoothing, fps: as in
            `suitable_window`. options: names of those that were given to the filter.

    Raises:
        InputError: no such method, one that cannot do what was asked for, or an option that it does
            not use.
    """
    chosen = _default(prior, smoothing, fps, options) if method is None else Chosen(method, ())
    _check_method(chosen.method)
    if smoothing is not None and chosen.method not in SMOOTHABLE:
        raise InputError(
            f"smoothing needs method {' or '.join(map(repr, SMOOTHABLE))}, got {chosen.method!r}"
        )
    if method == WINDOWS and suitable_window(prior, smoothing, fps or 30.0) is None:
        raise InputError(
            f"method {WINDOWS!r} cannot be used: {_missing(prior, smoothing, fps)}; use method "
            f"{SINGLE_POSES!r}"
        )
    check_options(chosen.method, options)
    return chosen


def _check_method(method: str) -> None:
    if method not in METHODS:
        raise InputError(f"method must be one of {', '.join(METHODS)}, got {method!r}")


def _default(
    prior: UpperBodyPrior, smoothing: int | str | None, fps: float | None, options: Iterable[str]
) -> Chosen:
    """The choice where no method was named."""
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
        return Chosen(WINDOWS, ())
    if not prior.windows:
        return Chosen(SINGLE_POSES, ())
    reason = _missing(prior, smoothing, fps)
    return Chosen(SINGLE_POSES, (f"single poses are tracked ({SINGLE_POSES}), since {reason}",))


def _missing(prior: UpperBodyPrior, smoothing: int | str | None, fps: float | None) -> str:
    """Why the prior has no window that suits."""
    name = "causal" if smoothing is None else "full"
    if name not in prior.windows:
        use = "filtering" if smoothing is None else "smoothing"
        return f"the prior brings no mixtures over windows for {use}"
    ahead = prior.windows[name].layout.at_rate(fps or 30.0).ahead
    return f"the prior's windows look {ahead} frames ahead, and smoothing may use {smoothing}"


def options_of_before(
    method: str | None, window: bool, steady: bool | None
) -> tuple[str | None, bool | None]:
    """Return the method and `steady` that the former argument `window` stands for.

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
