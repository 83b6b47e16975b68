"""Set up the particle filter of `BodyTracker`: the bodies, the model and the filter of its method."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchpose.body._kinematics import Body
from torchpose.body._skeleton import BODY_15
from torchpose.camera._rig import CameraRig
from torchpose.whole_body._body_track import load_body
from torchpose.whole_body._filter_table import LEARNT, METHODS, make_filter, rebased
from torchpose.whole_body._particle_follower import ParticleFollower

_HEIGHT = 1.75  # metres, of a person of unknown height


def set_up_particles(
    method: str,
    rig: CameraRig,
    given: Mapping[str, Any],
    body: Body | str | Path | None,
    height: float | None,
    fps: float,
    n_particles: int,
    options: Mapping[str, Any],
    noise: tuple[float | None, float | None],
) -> ParticleFollower:
    """Return the filter of a method with what finds its first pose.

    Args:
        method: among `METHODS`. rig: the cameras. given: models, names or files by kind.
        options: of the filter. noise: of keypoints, metres and pixels.
        body, height, fps, n_particles: as `BodyTracker`.
    """
    found = {kind: _model(kind, value, fps) for kind, value in given.items()}
    models = {kind: model for kind, (model, _) in found.items()}
    person = rebased(_person(body, _HEIGHT if height is None else height), "parent", None)
    upright, tracked, learnt = _bodies(method, person, models)
    particles = make_filter(method, tracked, learnt, fps, n_particles, options)
    own = METHODS[method].needs == "manifold"  # then the filter holds it
    manifold = None if own else models.get("manifold")
    notes = tuple(note for _, note in found.values() if note)
    start_body = (
        None if upright is tracked else upright
    )  # so that its tensors are in the state once
    return ParticleFollower(method, particles, rig, fps, start_body, manifold, noise, notes)


def _model(kind: str, value: Any, fps: float) -> tuple[Any, str]:
    """Return a model with its noise for a frame rate, and notes about it."""
    model = LEARNT[kind].load(value) if isinstance(value, str | Path) else value
    return LEARNT[kind].at_rate(model, fps), LEARNT[kind].rescaled(model, fps)


def _person(body: Body | str | Path | None, height: float) -> Body:
    if isinstance(body, Body):
        return body
    return Body.of_height(BODY_15, height) if body is None else load_body(body)


def _bodies(method: str, person: Body, models: dict[str, Any]) -> tuple[Body, Body, Any]:
    """Return the body with which the first pose is found, the one that is tracked, and the method's model."""
    upright, needs = person, METHODS[method].needs
    if "manifold" in models:
        upright = LEARNT["manifold"].body(person, models["manifold"])
    if needs is None:
        return upright, person, None
    tracked = upright if needs == "manifold" else LEARNT[needs].body(person, models[needs])
    return upright, tracked, models[needs]
