"""Which filter `torchpose track-body` tracks with, the files it needs, and the body it moves."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from jsonargparse import Namespace

from torchpose.errors import InputError, PriorError

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.body.kinematics import Body
    from torchpose.priors.actions.bank import ActionBank
    from torchpose.priors.actions.space import ActionSpace
    from torchpose.priors.limb_conditionals import LimbConditionals
    from torchpose.priors.manifold.gplvm import BackConstrainedGPLVM
    from torchpose.whole_body.filters.silhouette_filter import SilhouetteParticleFilter

__all__ = [
    "METHODS",
    "BodyModel",
    "check_method",
    "default_sharpness",
    "load_model",
    "model_of",
]

METHODS = ("mrpf", "apf", "sir", "root", "constrained")
_FILES = {"mrpf": "manifold", "root": "conditionals", "constrained": "action"}
_HELD = {
    "manifold": "a manifold of the action's poses (such as walk, or of torchpose fit manifold)",
    "conditionals": "limb conditionals (such as walk, or of torchpose fit limbs)",
    "action": "an action space or a bank of several (such as exercises, or of torchpose fit actions)",
}  # and the command that makes the file
_SHARPNESS = {"constrained": 30.0}  # of the overlap; of the bidirectional likelihood:
_SHARP = 100.0
_LAYERS = 5  # of the annealed filter, each with its share of the particles
_POINTS = 7  # likelihoods that a hypothesis of the root costs
_LEAST_PARTICLES = {"root": 3 * _POINTS, "apf": 4 * _LAYERS}  # of which two survive
_RATE = 60.0  # frames per second for which the default noise of the filters is
_MANIFOLD_STEP = 2.0  # times sigma x->x of the manifold, which was learnt from the true poses
_LEG_SWAP = 0.02
_COMMON_HEIGHT = 1.75  # metres, of the body on which postures of actions are told
# What a constant velocity misses, at 60 Hz, about twice that of walks and exercises: metres for the
# root, sines of half angles for its orientation and for parts.
_FIRST_ORDER_STD = (0.004, 0.006, 0.01)


def check_method(args: Namespace) -> None:
    """Settle `args.method` and `args.sharpness`, or refuse options that do not go together."""
    given = [option for option in _HELD if getattr(args, option)]
    if args.method is None:
        wanted = [method for method, option in _FILES.items() if option in given]
        if len(wanted) > 1:
            raise InputError(
                f"{' and '.join(f'--{option}' for option in given)} belong to different filters; choose "
                f"by --method {'|'.join(wanted)} and leave out the other file"
            )
        args.method = wanted[0] if wanted else "apf"
    if args.method not in METHODS:
        raise InputError(f"--method must be one of {', '.join(METHODS)}, got {args.method!r}")
    needed = _FILES.get(args.method)
    if needed and needed not in given:
        raise InputError(f"--method {args.method} needs --{needed} NAME|FILE, {_HELD[needed]}")
    for option in given:
        if option in (needed, "manifold"):
            continue
        own = next(method for method, file in _FILES.items() if file == option)
        raise InputError(
            f"--{option} does nothing for --method {args.method}; leave it out or take --method {own}"
        )
    if needed != "manifold" and args.manifold and args.initial_pose:
        raise InputError(f"--manifold does nothing for --method {args.method} with an initial pose")
    if args.method == "root":
        if args.sharpness is not None:
            raise InputError(
                "--sharpness does nothing for --method root, whose weights keep a fixed share of the "
                "hypotheses; leave it out"
            )
    elif args.sharpness is None:
        args.sharpness = default_sharpness(args.method)
    least = _LEAST_PARTICLES.get(args.method, 1)
    if args.n_particles < least:
        raise InputError(
            f"--n-particles must be at least {least} for --method {args.method}, so that several "
            f"survive a frame, got {args.n_particles}"
        )


def default_sharpness(method: str) -> float | None:
    """Exponent of the likelihood; None for the method "root", which has none."""
    return None if method == "root" else _SHARPNESS.get(method, _SHARP)


@dataclass(frozen=True)
class BodyModel:
    """A method, what it has learnt, and the bodies that go with it.

    Attributes:
        method: among `METHODS`. body: that is tracked, in the frame and with the centres that the
            method needs. upright: the same person, on whom the first pose is looked for.
        manifold, conditionals, action: from their files, or None. fitted_fps: of the manifold's noise,
            before `at_rate`.
    """

    method: str
    body: "Body"
    upright: "Body"
    manifold: "BackConstrainedGPLVM | None" = None
    conditionals: "LimbConditionals | None" = None
    action: "ActionSpace | ActionBank | None" = None
    fitted_fps: float | None = None

    @property
    def action_names(self) -> tuple[str, ...]:
        """Of the columns of `details["actions"]`, with a bank."""
        return tuple(getattr(self.action, "names", ()))

    def at_rate(self, fps: float) -> "BodyModel":
        """The same with the manifold's noise for a frame rate, which only the manifold lacks.

        Raises:
            PriorError: the manifold's file does not say how its noise grows, and the rate is another.
        """
        if self.manifold is None:
            return self
        return replace(self, manifold=self.manifold.at_rate(fps), fitted_fps=self.manifold.info.fps)

    def make_filter(
        self, n_particles: int, sharpness: float | None, fps: float
    ) -> "SilhouetteParticleFilter":
        """The filter; its diffusion grows with the time between frames.

        Args:
            n_particles: likelihoods of a frame, of all layers or sigma points together.
            sharpness: exponent of the likelihood; None for the method "root", which has none.
            fps: frames per second.
        """
        from torchpose import whole_body
        from torchpose.whole_body.filters.first_order import rescale_std

        body, step = self.body, whole_body.default_step_std(self.body) * (_RATE / fps) ** 0.5
        if self.conditionals is not None:
            return whole_body.RootUncertaintyTracker(
                body, self.conditionals, n_particles // _POINTS, fps=fps, step_std=step,
                leg_swap=_LEG_SWAP,
            )  # fmt: skip
        common: dict[str, Any] = {"step_std": step, "sharpness": sharpness}
        if self.action is not None:
            step[:3], step[3:6], step[6:] = _FIRST_ORDER_STD
            common["step_std"] = rescale_std(step, 1 / _RATE, 1 / fps)
            return whole_body.ConstrainedParticleFilter(
                body, self.action, n_particles, fps=fps, likelihood="overlap",
                posture_body=self._posture_body(), **common,
            )  # fmt: skip
        if self.method == "mrpf" and self.manifold is not None:
            step[list(body.relative_columns)] = _MANIFOLD_STEP * self.manifold.std_step.to(step)
            return whole_body.ManifoldParticleFilter(
                body, self.manifold, n_particles, fps=fps, **common
            )
        if self.method == "sir":
            return whole_body.SIRParticleFilter(body, n_particles, **common)
        return whole_body.AnnealedParticleFilter(
            body, n_particles // _LAYERS, n_layers=_LAYERS, **common
        )

    def first_std(self, model: "SilhouetteParticleFilter") -> "Tensor":
        """Spread of the first particles [D]; the root alone where limbs have Gaussians of their own."""
        spread = 2 * model.step_std
        if self.conditionals is not None:
            spread[list(self.body.relative_columns)] = 0.0
        return spread

    def notes(self, fps: float) -> tuple[str, ...]:
        """What was rescaled to the frame rate of the videos."""
        found = []
        if self.fitted_fps is not None and self.fitted_fps != fps:
            found.append(
                f"the manifold's noise was learnt at {self.fitted_fps:g} frames per second and "
                f"rescaled to {fps:g}"
            )
        if self.conditionals is not None and self.conditionals.info.fps != fps:
            found.append(
                f"the limbs' diffusion was learnt at {self.conditionals.info.fps:g} frames per second "
                f"and rescaled to {fps:g}"
            )
        bank = self.action if self.action_names else None
        if bank is not None and bank.info.fps is not None and bank.info.fps != fps:
            found.append(
                f"how long actions last was set at {bank.info.fps:g} frames per second and rescaled "
                f"to {fps:g}"
            )
        return tuple(found)

    def _posture_body(self) -> "Body | None":
        """The body on which the performances were put, if it is not the tracked one."""
        from torchpose.body.kinematics import Body
        from torchpose.body.skeleton import BODY_15

        known = self.action.info.extra.get("postures", "body" if self.action_names else "joints")  # type: ignore[union-attr]
        common = known == "body"
        return Body.of_height(BODY_15, _COMMON_HEIGHT) if common else None


def load_model(args: Namespace) -> BodyModel:
    """The models of the options, and the body put into the frame and centres that they need.

    Raises:
        PriorError: no such name or file, or of another body. FileFormatError: a file of another kind.
        SkeletonError: of other limbs.
    """
    from torchpose.priors.shipped import load_action, load_limb_conditionals, load_manifold

    manifold = load_manifold(args.manifold) if args.manifold else None
    learnt: Any = manifold if args.method == "mrpf" else None
    if args.conditionals:
        learnt = load_limb_conditionals(args.conditionals)
    if args.action:
        learnt = load_action(args.action)
    return model_of(args.method, _person(args), learnt, manifold)


def model_of(
    method: str,
    person: "Body",
    learnt: "BackConstrainedGPLVM | LimbConditionals | ActionSpace | ActionBank | None" = None,
    manifold: "BackConstrainedGPLVM | None" = None,
) -> BodyModel:
    """A method with what it has learnt, and a person put into the frame and centres that this needs.

    Args:
        method: among `METHODS`. person: bone lengths and shape. learnt: what the method tracks with, a
            manifold, limb conditionals or actions; None for methods that need nothing.
        manifold: to look for the first pose with, where the method tracks without one.

    Raises:
        PriorError: of another body. SkeletonError: of other limbs.
    """
    manifold = learnt if method == "mrpf" else manifold  # type: ignore[assignment]
    upright = tracked = _rebased(person, "parent", None)
    if manifold is not None:
        info = manifold.info
        if info.skeleton == upright.skeleton.names:  # else it is refused below
            upright = _rebased(upright, info.frame, info.centres or None)
        manifold.check_for(upright)
        tracked = upright if method == "mrpf" else tracked
    conditionals: Any = learnt if method == "root" else None
    if conditionals is not None:
        parts = conditionals.info.parts
        if parts != tracked.skeleton.parts:
            raise PriorError(
                f"expected limb conditionals of the parts {', '.join(tracked.skeleton.parts)}, got "
                f"{', '.join(parts)} ({conditionals.info.name}); fit them with `torchpose fit limbs`"
            )
        tracked = _rebased(tracked, "body", conditionals.centres)
    action: Any = learnt if method == "constrained" else None
    return BodyModel(method, tracked, upright, manifold, conditionals, action)


def _person(args: Namespace) -> "Body":
    from torchpose.body.kinematics import Body
    from torchpose.body.skeleton import BODY_15
    from torchpose.whole_body.poses import load_body

    return load_body(args.body) if args.body else Body.of_height(BODY_15, args.height)


def _rebased(body: "Body", frame: Any, centres: Any) -> "Body":
    """The same person with another frame and centres, none for None; the same body if it has them."""
    import torch

    wanted = torch.zeros_like(body.centres) if centres is None else torch.as_tensor(centres)
    wanted = wanted.to(body.centres)
    if body.frame == frame and torch.equal(body.centres, wanted):
        return body
    return body.altered(frame=frame, centres=wanted)
