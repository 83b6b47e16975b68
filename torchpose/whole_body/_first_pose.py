"""Find a first pose in the silhouettes of the first frames, which tell front from back."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from torchpose._core.checks import check_shape, check_tensors
from torchpose.body._fitting import fit_state
from torchpose.body._kinematics import Body
from torchpose.body._skeleton import other_side
from torchpose.camera._rig import Cameras, as_rig
from torchpose.errors import InputError
from torchpose.whole_body._filters.annealed import AnnealedParticleFilter
from torchpose.whole_body._filters.body_frames import is_seen, silhouette_score
from torchpose.whole_body._filters.motion import default_step_std
from torchpose.whole_body._pose_search import find_candidates, world_up

_LAYERS = 5  # of the annealed filter that tracks the candidates
_LEAST = 4 * _LAYERS  # likelihoods of a frame: two of a layer's particles survive
_RATE = 60.0  # frames per second for which `default_step_std` is
_SHARPNESS = 100.0  # exponent of the mean likelihood of a frame, as of the filters
_SURE = 3.0  # log-odds of a walk, and of bent knees, that leave no doubt
_BEND, _STEP = 0.1, 0.1  # metres of a walk, and of bent knees, that say about as much


class FirstPose(NamedTuple):
    """Holds the pose that was found, and the candidates from which it was chosen.

    Attributes:
        state: [D], in the first frame.
        candidates: [K, D], in the first frame. score: of each [K]; the state has the highest.
        log_likelihood: mean over the frames [K]. evidence: for the way that it faces [K].
    """

    state: Tensor
    candidates: Tensor
    score: Tensor
    log_likelihood: Tensor
    evidence: Tensor


@torch.no_grad()
def find_first_pose(
    body: Body,
    silhouettes: Bool[Tensor, "T C H W"],
    cameras: Cameras,
    prior: object = None,
    generator: torch.Generator | None = None,
    *,
    fps: float = _RATE,
    n_frames: int = 15,
    n_particles: int = 2000,
    n_tracking: int = 300,
    n_headings: int = 4,
    likelihood: str = "bidirectional",
    limits: object = None,
    up: Tensor | None = None,
    facing: Tensor | None = None,
) -> FirstPose:
    """Find the pose in the first frame, front and back told apart by the frames after it.

    A silhouette is nearly the same from behind. So the pose of every sector of headings is found in the
    first frame (`find_candidates`), and taken a second time turned round (`turned_round`); all of them
    are tracked through the frames by an annealed particle filter. The one with the highest

        100 mean_t log p(I_t | x_t) + `facing_evidence`

    is returned: people walk forwards, and their knees bend forwards. Somebody who walks backwards
    comes out turned round, and somebody who stands with straight legs by chance: give `facing` then.

    Args:
        body: whose pose it is. silhouettes: the silhouettes of the first frames, half a second or so; bool.
        cameras: the C cameras. prior: poses to start from, as `find_candidates`.
        generator: the generator of random numbers.
        fps: the frame rate of the frames. n_frames: that are looked at, evenly spread over those given.
        n_particles: of the search in the first frame. n_tracking: likelihoods of a candidate and frame.
        n_headings, likelihood, limits, up: as `find_candidates`.
        facing: [3], the world direction that the person faces to within 60 degrees, if it is known;
            then nothing is turned round.

    Returns:
        `FirstPose` with the state [D] and the K candidates [K, D].

    Raises:
        InputError: no frame, nobody seen in the first one, or a bad setting. Others: as
            `find_candidates`.
    """
    check_tensors(silhouettes=silhouettes)
    check_shape("silhouettes", silhouettes, ["T", "C", "H", "W"])
    if len(silhouettes) == 0 or n_frames < 1 or not 0 < fps < math.inf or n_tracking < _LEAST:
        raise InputError(
            "a first pose needs a frame, n_frames of 1 or more, a positive fps and n_tracking of "
            f"{_LEAST} or more, got {len(silhouettes)} frames, {n_frames}, {fps:g} and {n_tracking}"
        )
    rig = as_rig(cameras)
    up = world_up(rig, up).to(body.offsets)
    stride = math.ceil(len(silhouettes) / n_frames)
    frames = silhouettes[::stride].to(up.device)
    states = find_candidates(
        body, frames[:1], rig, prior, generator, n_particles=n_particles, n_headings=n_headings,
        likelihood=likelihood, limits=limits, up=up, facing=facing,
    ).states[0]  # fmt: skip
    if facing is None:
        states = torch.cat([states, turned_round(body, states)])
    model = AnnealedParticleFilter(
        body, n_tracking // _LAYERS, n_layers=_LAYERS, likelihood=likelihood, limits=limits,
        process_cov=(default_step_std(body) * math.sqrt(stride * _RATE / fps)).square(),
    )  # fmt: skip
    many = frames.expand(len(states), *frames.shape)
    spread = (2 * model.step_std).square()
    track = model(many, rig, states, generator=generator, initial_cov=spread).mean
    fit = _mean_log_likelihood(body, track, frames, rig, likelihood)
    evidence = facing_evidence(body, track, up)
    score = _SHARPNESS * fit + evidence
    first = track[:, 0]
    return FirstPose(first[score.argmax()], first, score, fit, evidence)


def turned_round(body: Body, states: Float[Tensor, "K D"]) -> Float[Tensor, "K D"]:
    """Return states with left and right exchanged: the person in the same place, facing the other way.

    The silhouettes are nearly the same; knees and elbows bend the other way.
    """
    names = body.skeleton.names
    other = [names.index(other_side(name)) for name in names]
    return fit_state(body, body.joints(states)[:, other])


def facing_evidence(
    body: Body, states: Float[Tensor, "*batch T D"], up: Float[Tensor, "3"]
) -> Float[Tensor, "*batch"]:
    """Return the log-evidence of tracks for the way they face: above 0 for forwards, below for backwards.

    3 tanh(s / 0.1 m) + 3 tanh(b / 0.1 m),

    s: how far the middle of the ankles moves in the direction that the pelvis faces, and b: how far
    the knees are ahead of the lines from hip to ankle, mean over legs and frames.

    Args:
        states: one track or several. up: direction of the world's vertical, of length one.
    """
    ahead = body.part_rotations(states)[..., 0, :, 2]
    ahead = normalize(ahead - (ahead @ up)[..., None] * up, dim=-1)
    joints, joint = body.joints(states), body.skeleton.joint
    hip, knee, ankle = (
        joints[..., [joint(f"left_{name}"), joint(f"right_{name}")], :]
        for name in ("hip", "knee", "ankle")
    )
    leg = normalize(ankle - hip, dim=-1)
    bend = (knee - hip) - ((knee - hip) * leg).sum(-1, keepdim=True) * leg
    bend = (bend * ahead[..., None, :]).sum(-1).mean((-2, -1))
    feet = ankle.mean(-2)
    step = ((feet[..., -1, :] - feet[..., 0, :]) * normalize(ahead.mean(-2), dim=-1)).sum(-1)
    return _SURE * ((step / _STEP).tanh() + (bend / _BEND).tanh())


def _mean_log_likelihood(
    body: Body, track: Tensor, frames: Tensor, rig: Cameras, likelihood: str
) -> Float[Tensor, " K"]:
    """Return the mean over the frames in which a camera sees the person."""
    values = silhouette_score(body, frames, rig, likelihood)(track.transpose(0, 1))
    return values[is_seen(frames)].mean(0)
