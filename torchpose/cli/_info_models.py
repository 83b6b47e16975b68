"""What `torchpose info` says of models of whole bodies (manifolds, limbs, actions, motion) and of poses."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchpose._core.wording import counted, first_of

if TYPE_CHECKING:
    from torch import Tensor

Facts = dict[str, str]
_LISTED, _SOURCES = 12, 3  # persons or actions that are named, and sources


def describe_manifold(path: Path) -> Facts:
    """Return the facts about a manifold of poses, by name."""
    from torchpose.priors._manifold.gplvm import BackConstrainedGPLVM

    manifold = BackConstrainedGPLVM.load(path)
    info = manifold.info
    n_frames, n_columns = manifold.poses.shape
    known = bool(manifold.std_pose.isfinite().all())
    return {
        "manifold": info.name or "without a name",
        "latent space": f"{manifold.latents.shape[-1]} dimensions",
        "poses": f"{n_frames} frames of {n_columns} columns, rotations against the {info.frame}",
        "noise": "for the filter" if known else "not fitted yet: the filter needs fit_gplvm_noise",
        "fps": _number(info.fps),
        "held-out error": _number(info.extra.get("held_out_error")),
        "actions": first_of(info.actions, _LISTED),
        **_origin(info),
        "track with": "torchpose track-body --manifold NAME|FILE",
    }


def describe_limbs(path: Path) -> Facts:
    """Return the facts about limb conditionals: how far each limb turns against its parent, and how fast."""
    from torchpose.priors._limb_conditionals import LimbConditionals

    limbs = LimbConditionals.load(path)
    info = limbs.info
    spread = _degrees(limbs.covariance)
    of_part = dict(zip(info.parts, _degrees(limbs.diffusion), strict=True))
    pairs = [(info.parts[i], info.parts[j]) for i, j in limbs.edges.tolist()]
    rows = [
        f"{below} on {above}: {value:.0f} degrees, {of_part[below]:.1f} from frame to frame"
        for (above, below), value in zip(pairs, spread, strict=True)
    ]
    rescaled = "" if info.fps == info.fitted_fps else f", learnt at {info.fitted_fps:g}"
    return {
        "limb conditionals": info.name or "without a name",
        "parts": ", ".join(info.parts),
        "fps": f"{info.fps:g}{rescaled}",
        "frames": str(info.n_frames),
        "limbs": "\n".join(rows),
        "held out": _held_out(info.extra),
        "actions": first_of(info.actions, _LISTED),
        **_origin(info),
        "track with": "torchpose track-body --method root --conditionals NAME|FILE",
    }


def describe_action(path: Path) -> Facts:
    """Return the facts about the action space of one action."""
    from torchpose.priors._actions.space import ActionSpace

    space = ActionSpace.load(path)
    info = space.info
    explained = "" if info.explained is None else f", {100 * info.explained:.1f} % of the variance"
    accepted = info.extra.get("accepted")
    told = {"body": "on a body of average proportions", "joints": "between the recorded joints"}
    return {
        "action": info.name or "without a name",
        "dimensions": f"{space.n_dimensions}{explained}",
        "mean performance": f"{space.n_postures} postures, {len(info.key_frames)} key frames",
        "performances": str(info.performances or ""),
        "postures": told.get(str(info.extra.get("postures")), ""),
        "gate": ""
        if accepted is None
        else f"lets {100 * accepted:.0f} % of held-out postures through",
        "fps": _number(info.fps),
        **_origin(info),
        "track with": "torchpose track-body --method constrained --action NAME|FILE",
    }


def describe_bank(path: Path) -> Facts:
    """Return the facts about a bank of actions."""
    from torchpose.priors._actions.bank import ActionBank

    bank = ActionBank.load(path)
    info = bank.info
    sizes = zip(info.names, bank.n_dimensions.tolist(), bank.n_postures.tolist(), strict=True)
    gated = info.gate_dimensions
    return {
        "action bank": f"{info.name or 'without a name'}: {len(info.names)} actions, or none of them",
        "actions": "\n".join(
            f"{name}: {d} dimensions, {k} postures{_passed(info, name)}" for name, d, k in sizes
        ),
        "gates": "of all dimensions" if gated is None else f"of the first {gated} dimensions",
        "staying": f"{info.stay:g}: probability of the same action a second later",
        "spread": f"{info.spread:g} for persons who are not of the training set",
        "fps": _number(info.fps),
        **_origin(info),
        "track with": "torchpose track-body --method constrained --action NAME|FILE",
    }


def describe_body_motion(path: Path) -> Facts:
    """Return the facts about a prior over the motion of bodies: how fast each part accelerates."""
    from torchpose.priors._body_motion import BodyMotion

    motion = BodyMotion.load(path)
    body, info = motion.articulation, motion.info
    acceleration, decay = motion.acceleration.tolist(), motion.decay.tolist()
    shifts = zip(body.shifted, motion.shift_std.tolist(), strict=True)
    scales = zip(body.groups, motion.scale_cov.diagonal().sqrt().tolist(), strict=True)
    return {
        "body motion": info.name or "without a name",
        "position": f"{acceleration[0]:.2g} m per s^1.5, decay {decay[0]:.2g} per s",
        "angles": "\n".join(
            f"{body.skeleton.parts[part]} about {'xyz'[axis]}: {q:.2g} rad per s^1.5, decay {beta:.2g} per s"
            for part, axis, q, beta in zip(
                body.axis_part.tolist(),
                body.axis.tolist(),
                acceleration[3:],
                decay[3:],
                strict=True,
            )
        ),
        "shifts": ", ".join(f"{body.skeleton.names[j]} {100 * std:.1f} cm" for j, std in shifts),
        "bone lengths": ", ".join(f"{name} +- {100 * std:.0f} %" for name, std in scales),
        "poses": f"{len(motion.poses.weights)} components over {motion.poses.dim} angles",
        "fps": _number(info.fps),
        "frames": str(info.n_frames or ""),
        "held out": _moved(info.extra),
        "actions": first_of(info.actions, _LISTED),
        **_origin(info),
        "track with": "torchpose track-body --motion NAME|FILE",
    }


def _moved(extra: dict[str, Any]) -> str:
    found = extra.get("held_out")
    if not isinstance(found, dict) or not {"frames", "acceleration"} <= found.keys():
        return ""
    return f"{found['frames']} frames, accelerating {found['acceleration']:.2f} times as much"


def _passed(info: Any, action: str) -> str:
    share = info.extra.get("accepted", {}).get(action)
    return "" if share is None else f"; {100 * share:.0f} % of held-out postures pass its gate"


DESCRIBED: dict[str, Callable[[Path], Facts]] = {
    "torchpose-manifold": describe_manifold,
    "torchpose-limb-conditionals": describe_limbs,
    "torchpose-action-space": describe_action,
    "torchpose-action-bank": describe_bank,
    "torchpose-body-motion": describe_body_motion,
}
"""What describes a file, by `torchpose._core.tensor_file.format_of`."""


def describe_body_poses(path: Path) -> Facts:
    """Return the facts about poses of a whole body, from `torchpose track-body`."""
    from torchpose.cli._track_body_output import action_text
    from torchpose.whole_body._body_track import BodyTrack

    poses = BodyTrack.load(path)
    spread = 100 * poses.joints_std().mean(0)
    stds = zip(poses.names, spread.tolist(), strict=True)
    rate = (
        "rate unknown" if not poses.fps else f"{len(poses) / poses.fps:.1f} s at {poses.fps:g} fps"
    )
    return {
        "body poses": str(path),
        "frames": f"{len(poses)} ({rate}) from frame {poses.first_frame}",
        "body": f"{poses.body.height:.2f} m, rotations against the "
        + ("root" if poses.body.frame == "body" else "part above"),
        "unseen": counted(int(poses.coasting.sum()), "frame") if bool(poses.coasting.any()) else "",
        "lost": counted(int(poses.respread.sum()), "frame") if bool(poses.respread.any()) else "",
        "details": ", ".join(poses.details),
        "actions": action_text(poses),
        "std per axis (cm)": ", ".join(f"{name} {value:.1f}" for name, value in stds),
        "notes": "; ".join(poses.notes),
    }


def _degrees(covariance: "Tensor") -> list[float]:
    """Return the standard deviation of each rotation's angle in degrees, from sines of half angles."""
    trace = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
    return [math.degrees(2 * math.asin(min(1.0, math.sqrt(value)))) for value in trace.tolist()]


def _held_out(extra: dict[str, Any]) -> str:
    found = extra.get("held_out")
    if not isinstance(found, dict) or not {"frames", "deviation", "speed"} <= found.keys():
        return ""
    return (
        f"{found['frames']} frames, whose limbs deviate {found['deviation']:.2f} times as the training "
        f"ones and turn {found['speed']:.2f} times as fast"
    )


def _origin(info: Any) -> Facts:
    persons = f"{len(info.persons)}: {first_of(info.persons, _LISTED)}" if info.persons else ""
    return {
        "persons": persons,
        "sources": first_of(getattr(info, "sources", ()), _SOURCES, "; "),
        "licence": info.licence,
        "command": info.command,
    }


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"
