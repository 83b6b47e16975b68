"""Model card of what the body trackers learn: manifolds, limb conditionals, action spaces and banks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from torchpose.learning.model_card import card_table, card_text
from torchpose.priors.actions.bank import ActionBank
from torchpose.priors.actions.space import ActionSpace
from torchpose.priors.limb_conditionals import LimbConditionals
from torchpose.priors.manifold.gplvm import BackConstrainedGPLVM

__all__ = ["BodyModel", "body_card"]

BodyModel = BackConstrainedGPLVM | LimbConditionals | ActionSpace | ActionBank

_LIMITS = (
    "It is not to be scored on the persons named above, and `torchpose evaluate` refuses that. It says "
    "nothing about who a person is."
)


def body_card(model: BodyModel, name: str = "", results: str = "") -> str:
    """Return Markdown text on what a model is, what it was fitted on, and what it is not good for.

    Args:
        model: a manifold, limb conditionals, an action space or a bank.
        name: of the model, where its file does not say. results: what it scored on persons whom it was
            not fitted on, as Markdown.
    """
    describe = next(text for kind, text in _DESCRIBED.items() if isinstance(model, kind))
    what, rows, held_out, use, limits = describe(model)
    sections = {
        "What it is": what,
        "Fitted on": card_table({**_data(model.info), **rows}),
        "Held out while it was fitted": held_out,
        "On persons that it was not fitted on": results,
        "Use": f"```console\n$ torchpose track-body cameras.toml cam1.mp4 cam2.mp4 {use} --out result\n```",
        "Limits": f"{limits} {_LIMITS}",
    }
    return card_text(getattr(model.info, "name", "") or name or "Body model", sections)


_Told = tuple[str, dict[str, Any], str, str, str]


def _manifold(manifold: Any) -> _Told:
    info, extra = manifold.info, manifold.info.extra
    n_frames, n_columns = manifold.poses.shape
    what = (
        f"A back-constrained GPLVM with {manifold.latent_dim} latent dimensions over {n_columns} columns: "
        f"the rotations of a body's parts against the {info.frame}, not where the person goes. The "
        "manifold-regularised particle filter weighs by the distance from it (Gonczarek & Tomczak, 2016)."
    )
    rows = {"frames": f"{n_frames:,}", "frame rate of its noise": _rate(info.fps)}
    held_out = ""
    if "held_out_error" in extra:
        of = _joined(extra.get("held_out_persons", ())) or "other recordings"
        held_out = (
            f"Poses of {of} ({extra['held_out_frames']:,} frames) chose the step of the fit and gave its "
            f"standard deviations. They come back from the manifold to within {extra['held_out_error']:.4f} "
            "(root mean square of a column, sine of half an angle)."
        )
    limits = (
        "It knows one motion. Somebody who does anything else is pulled towards it, and poses that are "
        "not of the motion come out wrong."
    )
    return what, rows, held_out, f"--manifold {_call(info.name)}", limits


def _limbs(limbs: Any) -> _Told:
    info, found = limbs.info, limbs.info.extra.get("held_out")
    what = (
        f"Gaussians over the rotations between {len(limbs.edges)} pairs of connected parts, and over "
        "those of each part from frame to frame, for the tracker with large uncertainty of the root "
        "(Daubney & Xie)."
    )
    held_out = ""
    if found:
        held_out = (
            f"Limbs of persons who were held out ({found['frames']:,} frames) deviate "
            f"{found['deviation']:.2f} times as much as those of the persons above, and turn "
            f"{found['speed']:.2f} times as fast."
        )
    rows = {"frames": f"{info.n_frames:,}", "frame rate of its diffusion": _rate(info.fps)}
    limits = (
        "It knows how these persons moved in these actions; limbs in other positions or faster ones are "
        "followed late or not at all."
    )
    return what, rows, held_out, f"--method root --conditionals {_call(info.name)}", limits


def _action(space: Any) -> _Told:
    info, accepted = space.info, space.info.extra.get("accepted")
    what = (
        f"{space.n_postures} postures of one action in {space.n_dimensions} dimensions, around which the "
        "constrained particle filter lets predictions through (Rius et al., 2006)."
    )
    held_out = _gates({info.name: accepted} if accepted is not None else {})
    rows = {"performances": info.performances, "frame rate": _rate(info.fps)}
    limits = "Somebody who does anything else is held in the postures of this action."
    return what, rows, held_out, f"--method constrained --action {_call(info.name)}", limits


def _bank(bank: Any) -> _Told:
    info = bank.info
    what = (
        f"Postures of {len(info.names)} actions, {_joined(info.names)}, and one state for none of them. The "
        "constrained particle filter keeps to the postures of the likeliest, and says which it is."
    )
    rows = {"actions": _joined(info.names), "frame rate": _rate(info.fps)}
    limits = (
        "It knows these actions; what is done otherwise is taken for one of them or for none, when the "
        "constraint is released."
    )
    use = f"--method constrained --action {_call(info.name)}"
    return what, rows, _gates(info.extra.get("accepted", {})), use, limits


_DESCRIBED: Mapping[type, Any] = {
    BackConstrainedGPLVM: _manifold,
    LimbConditionals: _limbs,
    ActionSpace: _action,
    ActionBank: _bank,
}


def _gates(accepted: Mapping[str, float]) -> str:
    if not accepted:
        return ""
    shares = ", ".join(f"{100 * share:.0f} % ({name})" for name, share in accepted.items())
    return f"Share of the postures of persons who were held out that pass the gate: {shares}."


def _data(info: Any) -> dict[str, Any]:
    origins = sorted({p.partition("#")[0] for p in info.persons})
    names = sorted(p.partition("#")[2] or p for p in info.persons)
    n = len(getattr(info, "sources", ()))
    return {
        "data": _joined(origins) + (f", {n} recordings" if n > 1 else ""),
        "persons": f"{len(names)}: {_joined(names)}" if names else "not stated",
        "actions": _joined(getattr(info, "actions", ())),
        "licence": info.licence or "not stated",
        "command": f"`{info.command}`" if info.command else "",
    }


def _rate(fps: float | None) -> str:
    return "" if fps is None else f"{fps:g} per second"


def _call(name: str) -> str:
    return name or "FILE"


def _joined(items: Iterable[str]) -> str:
    return ", ".join(items)
