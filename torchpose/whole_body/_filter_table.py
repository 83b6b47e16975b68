"""List the filters over whole bodies by name, with the models and options that each takes.

`METHODS` is the table of all of them. To add a filter, subclass `SilhouetteParticleFilter` and call
`register_body_filter`.
"""

import inspect
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from numbers import Integral
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchpose._core.checks import check_choice, refuse_unused
from torchpose._core.registry import add_method
from torchpose.body._kinematics import Body
from torchpose.errors import InputError, PriorError
from torchpose.priors._actions.bank import ActionBank
from torchpose.priors._actions.space import ActionSpace
from torchpose.priors._limb_conditionals import LimbConditionals
from torchpose.priors._manifold.gplvm import BackConstrainedGPLVM
from torchpose.priors._shipped import load_action, load_limb_conditionals, load_manifold
from torchpose.whole_body._filters.annealed import AnnealedParticleFilter
from torchpose.whole_body._filters.body_particles import BodyFilterOptions, WeightingOptions
from torchpose.whole_body._filters.constrained import ConstrainedParticleFilter
from torchpose.whole_body._filters.manifold_regularised import ManifoldParticleFilter
from torchpose.whole_body._filters.root_uncertainty import RootUncertaintyTracker
from torchpose.whole_body._filters.silhouette_filter import SilhouetteParticleFilter
from torchpose.whole_body._filters.sir import SIRParticleFilter
from torchpose.whole_body._keypoints.track_builder import KEYPOINT_METHOD

_DEFAULT = "apf"  # needs nothing
_DEPRECATED = {"step_std"}  # options that still work and are not listed


class BodyTrackerOptions(WeightingOptions, total=False):
    """The options of the filters of `METHODS` but for `process_cov`; each has some (`method_options`)."""

    step_std: Tensor | float | None
    survival_rate: float | None
    n_layers: int
    schedule: Sequence[float] | None
    noise_decay: float | None
    weights: str
    proposal: str
    survival_per_second: float | None
    normalisation: str
    camera_rule: str
    observation_sharpness: float
    least_std: float
    first_std: float
    weighting: str
    velocity_rate: float | None
    max_redraws: int
    gate_width: float
    posture_body: Body | None


class BodyMethod(NamedTuple):
    """Describes a filter that `BodyTracker` tracks with.

    Attributes:
        filter: its class. needs: the kind of model that it tracks with, among `LEARNT`, which is also
            the name of the argument that takes it; None if it needs nothing.
    """

    filter: type[SilhouetteParticleFilter]
    needs: str | None = None


METHODS: dict[str, BodyMethod] = {
    "mrpf": BodyMethod(ManifoldParticleFilter, needs="manifold"),
    "apf": BodyMethod(AnnealedParticleFilter),
    "sir": BodyMethod(SIRParticleFilter),
    "root": BodyMethod(RootUncertaintyTracker, needs="conditionals"),
    "constrained": BodyMethod(ConstrainedParticleFilter, needs="action"),
}
"""Every filter by the name of its method; see `register_body_filter`."""


def register_body_filter(
    name: str, filter_class: type[SilhouetteParticleFilter], needs: str | None = None
) -> None:
    """Add a filter to `METHODS`, for `BodyTracker`, `torchpose track-body` and the benchmarks.

    Its options are the arguments of its constructor, whose first two are `body` and `n_particles`; a
    model that it needs and `fps` are given by name where the constructor takes them.

    Args:
        name: of the method. filter_class: the filter. needs: "manifold", "conditionals" or "action", if
            it tracks with one of these.

    Raises:
        InputError: not a filter over body poses, a name that another one has, or a need of another kind.
    """
    if not (isinstance(filter_class, type) and issubclass(filter_class, SilhouetteParticleFilter)):
        raise InputError(
            f"expected a subclass of SilhouetteParticleFilter, got {filter_class!r:.80}"
        )
    if needs is not None and needs not in LEARNT:
        raise InputError(f"needs must be one of {', '.join(LEARNT)} or None, got {needs!r}")
    add_method(METHODS, name, BodyMethod(filter_class, needs))


# --- what filters have learnt ---------------------------------------------------------------------


class LearntKind(NamedTuple):
    """Describes a kind of model that filters track with.

    Attributes:
        types: of models. load: (name or file) -> model. words: what it is, and the command that makes one.
        body: (upright body, model) -> the same person in the frame and about the centres of the model;
            refuses a model of another skeleton.
        at_rate: (model, frames per second) -> the model with its noise for this rate.
        rescaled: (model, frames per second) -> what to say of a model that was learnt at another rate.
    """

    types: tuple[type, ...]
    load: Callable[[str | Path], Any]
    words: str
    body: Callable[[Body, Any], Body]
    at_rate: Callable[[Any, float], Any]
    rescaled: Callable[[Any, float], str]


def rebased(body: Body, frame: Any, centres: Any) -> Body:
    """Return a person in another frame and about other centres, none for None; itself if it is."""
    wanted = torch.zeros_like(body.centres) if centres is None else torch.as_tensor(centres)
    wanted = wanted.to(body.centres)
    if body.frame == frame and torch.equal(body.centres, wanted):
        return body
    return body.altered(frame=frame, centres=wanted)


def _body_of_manifold(upright: Body, manifold: BackConstrainedGPLVM) -> Body:
    info = manifold.info
    if info.skeleton == upright.skeleton.names:  # else it is refused below
        upright = rebased(upright, info.frame, info.centres or None)
    manifold.check_for(upright)
    return upright


def _body_of_conditionals(upright: Body, conditionals: LimbConditionals) -> Body:
    info, parts = conditionals.info, upright.skeleton.parts
    if info.parts != parts:
        raise PriorError(
            f"expected limb conditionals of the parts {', '.join(parts)}, got "
            f"{', '.join(info.parts)} ({info.name}); fit them with `torchpose fit limbs`"
        )
    return rebased(upright, "body", conditionals.centres)


def _rescaled(what: str, verb: str) -> Callable[[Any, float], str]:
    def say(model: Any, fps: float) -> str:
        fitted = model.info.fps
        if fitted is None or fitted == fps:
            return ""
        return f"{what} was {verb} at {fitted:g} frames per second and rescaled to {fps:g}"

    return say


def _rescaled_actions(action: Any, fps: float) -> str:
    several = bool(getattr(action, "names", ()))
    return _rescaled("how long actions last", "set")(action, fps) if several else ""


LEARNT = {
    "manifold": LearntKind(
        (BackConstrainedGPLVM,),
        load_manifold,
        "a manifold of the action's poses (such as walk, or of torchpose fit manifold)",
        _body_of_manifold,
        lambda manifold, fps: manifold.at_rate(fps),
        _rescaled("the manifold's noise", "learnt"),
    ),
    "conditionals": LearntKind(
        (LimbConditionals,),
        load_limb_conditionals,
        "limb conditionals (such as walk, or of torchpose fit limbs)",
        _body_of_conditionals,
        lambda conditionals, fps: conditionals,  # the filter rescales them
        _rescaled("the limbs' diffusion", "learnt"),
    ),
    "action": LearntKind(
        (ActionSpace, ActionBank),
        load_action,
        "an action space or a bank of several (such as exercises, or of torchpose fit actions)",
        lambda upright, action: upright,
        lambda action, fps: action,  # the filter rescales a bank's transitions
        _rescaled_actions,
    ),
}
"""Kinds of models that filters track with, by the arguments that take them."""


# --- which filter, with which options -------------------------------------------------------------


def choose_method(method: str | None, given: Collection[str]) -> str:
    """Return the method that tracks: the one named, else that of the model given, else "apf".

    A manifold goes with every method: the first pose is looked for with it.

    Args:
        method: a name of `METHODS`, or None. given: the kinds of models that were given.

    Raises:
        InputError: an unknown method, one whose model is missing, models of several methods, or one that
            the method does not use.

    >>> choose_method(None, ["conditionals"]), choose_method(None, []), choose_method("sir", ["manifold"])
    ('root', 'apf', 'sir')
    """
    first = {one.needs: name for name, one in reversed(METHODS.items())}
    if method is None:
        wanted = [first[kind] for kind in LEARNT if kind in given]
        if len(wanted) > 1:
            raise InputError(
                f"{' and '.join(kind for kind in LEARNT if kind in given)} belong to different "
                f"filters; choose by method {' or '.join(wanted)}"
            )
        return wanted[0] if wanted else _DEFAULT
    if method not in METHODS:
        check_choice("method", method, (KEYPOINT_METHOD, *METHODS))
    _check_method(method)
    needs = METHODS[method].needs
    if needs is not None and needs not in given:
        raise InputError(f"method {method} needs {needs}, {LEARNT[needs].words}")
    for kind in given:
        if kind not in (needs, "manifold"):
            raise InputError(
                f"{kind} does nothing for method {method}; leave it out or take method {first[kind]}"
            )
    return method


def method_options(method: str) -> tuple[str, ...]:
    """Return the options of a method's filter, from its constructor.

    Args:
        method: a name of `METHODS`.

    Raises:
        InputError: no such method.

    >>> "n_layers" in method_options("apf"), "n_layers" in method_options("sir")
    (True, False)
    """
    _check_method(method)
    filter_class = METHODS[method].filter
    parameters = inspect.signature(filter_class).parameters.values()
    names = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY and p.name != "fps"]
    if any(p.kind is p.VAR_KEYWORD for p in parameters):
        names += [name for name in BodyFilterOptions.__annotations__ if name not in names]
    unlisted = filter_class.unused | _DEPRECATED
    return tuple(name for name in names if name not in unlisted)


def check_options(method: str, options: Iterable[str]) -> None:
    """Refuse options that a method does not use, and name the method that does.

    Raises:
        InputError: such an option.
    """
    said = f"does nothing for method {method}"
    options = (name for name in options if name not in _DEPRECATED)
    refuse_unused(options, said, method, METHODS, method_options)


def make_filter(
    method: str, body: Body, learnt: Any, fps: float, n_particles: int, options: Mapping[str, Any]
) -> SilhouetteParticleFilter:
    """Return the filter of a method, with its usual noise and sharpness for tracking from images.

    Args:
        method: a name of `METHODS`. body: in the frame of `learnt`. learnt: the model that the method
            needs. fps: frames per second. n_particles: likelihoods of a frame, of all layers or places
            of the parts together. options: the options of the filter, before the usual ones.

    Raises:
        InputError: an option that the filter does not use, or too few particles.
    """
    check_options(method, options)
    filter_class, needs = METHODS[method]
    cost = filter_class.likelihoods_per_particle(options)
    least = cost * filter_class.least_particles
    if not isinstance(n_particles, Integral) or n_particles < least:
        raise InputError(
            f"n_particles must be a whole number and at least {least} for method {method}, so that several "
            f"survive a frame, got {n_particles}"
        )
    settings = filter_class.tracking_options(body, fps, learnt)
    if options.keys() & {"process_cov", "step_std"}:  # one replaces the other
        settings.pop("process_cov", None)
        settings.pop("step_std", None)
    settings.update(options)
    if needs is not None:
        settings[needs] = learnt
    if "fps" in inspect.signature(filter_class).parameters:
        settings["fps"] = fps
    return filter_class(body, n_particles=n_particles // cost, **settings)


def _check_method(method: str) -> None:
    check_choice("method", method, METHODS)
