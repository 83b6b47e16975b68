"""Write the model cards of priors and of body models from what their files say about themselves."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from torchpose._core.files import atomic_path
from torchpose.priors._actions.bank import ActionBank
from torchpose.priors._actions.space import ActionSpace
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._limb_conditionals import LimbConditionals
from torchpose.priors._manifold.gplvm import BackConstrainedGPLVM
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.priors._window import WindowPrior

MODES = {"pose": "single poses", "causal": "filtered", "full": "smoothed"}
"""What cards and commands call the ways of tracking."""


def model_card(prior: UpperBodyPrior, results: Mapping[str, str] | None = None) -> str:
    """Return Markdown text on what a prior is, what it was fitted to, and what it is not good for.

    Args:
        prior: the prior.
        results: lines of a table of results, value by what was measured. They have to come from
            the same recipe fitted without the test persons.
    """
    sections = {
        "What it is": _description(prior),
        "Fitted on": _data(prior),
        "Conventions": _conventions(prior),
        "Noise": _noise(prior),
        "On persons that it was not fitted on": _held_out(prior),
        "Results": _results(results or {}),
        "Limits": _limits(prior),
    }
    return card_text(prior.info.name or "Upper-body prior", sections)


def write_model_card(
    prior: UpperBodyPrior, path: str | Path, results: Mapping[str, str] | None = None
) -> None:
    """Write `model_card` to a file, which appears whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(model_card(prior, results), encoding="utf-8")


def card_text(title: str, sections: Mapping[str, str]) -> str:
    """Return a card in Markdown: a title, and the sections that have a text."""
    body = [f"## {name}\n\n{text}\n" for name, text in sections.items() if text]
    return f"# {title}\n\n" + "\n".join(body)


def card_table(rows: Mapping[str, Any]) -> str:
    """Return a table of names and values, without those that are empty."""
    lines = [f"| {name} | {_cell(value)} |" for name, value in rows.items() if value]
    return "\n".join(["| | |", "|---|---|", *lines])


def _cell(value: Any) -> str:
    """Return a value as it can stand in a table of Markdown."""
    return " ".join(str(value).splitlines()).replace("|", "\\|")


def _description(prior: UpperBodyPrior) -> str:
    same = ", the right one the mirror image of the left one" if prior.info.mirrored else ""
    return (
        f"A Gaussian mixture with {prior.left.n_components} components for the left arm and "
        f"{prior.right.n_components} for the right arm{same}, over (u, v, lambda) of hand, elbow, "
        "shoulder, head and neck and the camera's roll, pitch, yaw and position, after Burke & "
        "Lasenby (BL 7). Trackers use it to tell joints that are not measured, and depth, from "
        "those that are."
    ) + "".join(_window(name, window) for name, window in sorted(prior.windows.items()))


def _window(name: str, window: WindowPrior) -> str:
    layout = window.layout
    own, other = (", ".join(str(lag) for lag in lags) for lags in (layout.own, layout.other))
    settings = ", ".join(f"{key} {value:g}" for key, value in sorted(window.settings.items()))
    return (
        f"\n\nWindows `{name}`: {window.left.n_components} components over an arm's state with its "
        f"own hand {own} and the other hand {other} frames before (negative: after), at "
        f"{layout.fps:g} frames per second; {settings}."
    )


def _data(prior: UpperBodyPrior) -> str:
    info = prior.info
    rows: dict[str, Any] = {
        "sources": "; ".join(info.sources) or "not stated",
        "persons": f"{len(info.persons)}: {'; '.join(info.persons)}"
        if info.persons
        else "not stated",
        "licence": info.licence or "not stated",
        "recorded frames": f"{info.n_frames:,}" if info.n_frames else "not stated",
        "training states per arm": f"{info.n_samples:,}" if info.n_samples else "not stated",
        "viewpoints": _views(info.views),
        "command": f"`{info.command}`" if info.command else "",
    }
    extra = info.extra
    if "frames_left_out" in extra:
        left_out = extra["frames_left_out"]
        rows["frames left out for a missing joint"] = ", ".join(
            f"{count:,} ({side} arm)" for side, count in left_out.items()
        )
    if "neck_offset" in extra:
        residual = 100 * extra["neck_offset"]["residual"]
        rows["necks converted"] = (
            f"{extra['frames_with_converted_neck']:,} frames, to within {residual:.1f} cm "
            "(root mean square on necks of the wanted kind)"
        )
    if "curation" in extra:
        dropped = extra["curation"]["dropped"].items()
        rows["left out by curation"] = ", ".join(f"{n} ({why})" for why, n in dropped) or "nothing"
    if "fine_tuned" in extra:
        rows["fine-tuned"] = _fine_tuned(extra["fine_tuned"])
    if "fit" in extra:
        fit = extra["fit"]
        rows["fit"] = (
            f"mean log-likelihood {fit['log_likelihood']:.4f} after {fit['iterations']} iterations"
            f"{'' if fit['converged'] else ' (not converged)'}, seed {extra.get('seed')}"
        )
    return card_table(rows)


def _fine_tuned(facts: Mapping[str, Any]) -> str:
    before = facts["error_before"]
    errors = (
        f"{m} {100 * before[m]:.2f} -> {100 * e:.2f}" for m, e in facts["error_after"].items()
    )
    return (
        f"from {facts['from']} by {facts['steps']} steps, stopped on {', '.join(facts['held_out'])}; "
        f"error there in cm: {', '.join(errors)}"
    )


def _conventions(prior: UpperBodyPrior) -> str:
    info = prior.info
    orders = {"zxy": "Rz(roll) Rx(pitch) Ry(yaw)", "zyx": "Rz(roll) Ry(yaw) Rx(pitch)"}
    return card_table(
        {
            "camera": f"fx {info.fx:g}, fy {info.fy:g}, centre ({info.cx:g}, {info.cy:g}) pixels",
            "rotation": f"{info.rotation_order}: R = {orders[info.rotation_order]}",
            "poses centred on": info.centre,
            "kind of neck": info.neck or "not stated",
            "kind of hand": info.hand or "not stated",
            "frames per second": f"{info.fps:g}" if info.fps else "not stated",
        }
    )


def _noise(prior: UpperBodyPrior) -> str:
    if not prior.noise:
        return ""
    names = ", ".join(f"`{name}` {list(value.shape)}" for name, value in prior.noise.items())
    text = f"Learnt for the transition `{prior.info.transition}`: {names}."
    later = prior.info.extra.get("noise")
    if later:
        text += (
            f" Process noise and calibration over single poses by recipe {later['recipe']}, "
            + (f"`{later['command']}`." if later["command"] else "after the mixtures.")
        )
    return text + _drawn(prior)


def _drawn(prior: UpperBodyPrior) -> str:
    """Return errors of the sampling filters, on fewer frames of the same held-out persons."""
    held_out: Mapping[str, Mapping[str, float]] = prior.info.extra.get("held_out_drawn", {})
    errors = ", ".join(
        f"`{mode.replace('_', '-')}` {100 * fmean(persons.values()):.1f}"
        for mode, persons in held_out.items()
    )
    return f"\n\nOver single poses, mean over persons held out, cm: {errors}." if errors else ""


def _held_out(prior: UpperBodyPrior) -> str:
    """Return a table of errors on held-out persons, for each way of tracking."""
    held_out: Mapping[str, Mapping[str, float]] = prior.info.extra.get("held_out", {})
    if not held_out:
        known = not prior.info.persons or "fine_tuned" in prior.info.extra
        return "" if known else "Not known: no person was held out."
    still = prior.info.extra.get("held_out_still", {})
    columns = {"mean pose": still} if still else {}
    columns |= {MODES[mode]: held_out[mode] for mode in sorted(held_out, key=list(MODES).index)}
    persons = sorted(next(iter(held_out.values())))
    rows = [
        [_cell(person), *(f"{100 * own.get(person, math.nan):.1f}" for own in columns.values())]
        for person in persons
    ]
    values = [[100 * value for value in own.values()] for own in columns.values()]
    rows.append(["mean", *(f"{fmean(column):.1f}" for column in values)])
    if len(persons) > 1:
        rows.append(["standard deviation", *(f"{stdev(column):.1f}" for column in values)])
    lines = ["| person | " + " | ".join(columns) + " |"]
    lines.append("|---|" + "---:|" * len(columns))
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return (
        "3D error in cm, after fixed-scale Procrustes on head, neck and shoulders, from head, neck "
        "and hands with 3 pixels of noise. Each person was tracked by the same recipe at half its "
        "size, fitted to others; somebody new can expect the mean, give or take the standard "
        "deviation."
        + " The mean pose of that fit, which looks at nothing, is there to compare with."
        * bool(still)
        + "\n\n"
        + "\n".join(lines)
    )


def _results(results: Mapping[str, str]) -> str:
    if not results:
        return ""
    return "From the same recipe, fitted without the test persons.\n\n" + card_table(results)


def _limits(prior: UpperBodyPrior) -> str:
    persons = len(prior.info.persons)
    few = f"It knows {persons} person{'s' * (persons != 1)} and what they did. " if persons else ""
    return (
        f"{few}It is not to be scored on them. Persons of other build, seated persons, views from "
        "the side or from behind and viewpoints outside the limits above are outside what it was "
        "fitted on. It says nothing about who a person is."
    )


def _views(views: Mapping[str, Any]) -> str:
    if not views:
        return "not stated"
    angles = ", ".join(f"{a} ±{math.degrees(views[a]):g}°" for a in ("roll", "pitch", "yaw"))
    shifts = ", ".join(f"{t} {views[t][0]:g} to {views[t][1]:g} m" for t in ("tx", "ty", "tz"))
    return f"{angles}, {shifts}"


BodyModel = BackConstrainedGPLVM | LimbConditionals | ActionSpace | ActionBank | BodyMotion

_LIMITS = (
    "It is not to be scored on the persons named above, and `torchpose evaluate` refuses that. It says "
    "nothing about who a person is."
)


def body_card(model: BodyModel, results: str = "", chosen: str = "", file: str = "") -> str:
    """Return Markdown text on what a model is, what it was fitted to, and what it is not good for.

    Args:
        model: a manifold, limb conditionals, an action space or bank, or a prior over the motion of bodies.
        results: what it scored on persons whom it was not fitted on, as Markdown.
        chosen: how settings were chosen, as Markdown.
        file: name of the model's file, by which it is used; of a model of the package its name is enough.
    """
    name = model.info.name
    describe = next(text for kind, text in _DESCRIBED.items() if isinstance(model, kind))
    what, rows, held_out, use, limits = describe(model, file or name or "FILE")
    sections = {
        "What it is": what,
        "Fitted on": card_table({**_body_data(model.info), **rows}),
        "Held out while it was fitted": held_out,
        "How its settings were chosen": chosen,
        "On persons that it was not fitted on": results,
        "Use": use,
        "Limits": f"{limits} {_LIMITS}",
    }
    return card_text(name or "Body model", sections)


_Told = tuple[str, dict[str, Any], str, str, str]


def _tracking(options: str) -> str:
    return f"```console\n$ torchpose track-body cameras.toml cam1.mp4 cam2.mp4 {options} --out result\n```"


def _manifold(manifold: BackConstrainedGPLVM, call: str) -> _Told:
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
        of = _listed(extra.get("held_out_persons", ())) or "other recordings"
        held_out = (
            f"Poses of {of} ({extra['held_out_frames']:,} frames) chose the step of the fit and gave its "
            f"standard deviations. They come back from the manifold to within {extra['held_out_error']:.4f} "
            "(root mean square of a column, sine of half an angle)."
        )
    limits = (
        "It knows one motion. Somebody who does anything else is pulled towards it, and poses that are "
        "not of the motion come out wrong."
    )
    return what, rows, held_out, _tracking(f"--manifold {call}"), limits


def _limbs(limbs: LimbConditionals, call: str) -> _Told:
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
    return what, rows, held_out, _tracking(f"--method root --conditionals {call}"), limits


def _action(space: ActionSpace, call: str) -> _Told:
    info, accepted = space.info, space.info.extra.get("accepted")
    what = (
        f"{space.n_postures} postures of one action in {space.n_dimensions} dimensions, around which the "
        "constrained particle filter lets predictions through (Rius et al., 2006)."
    )
    held_out = _gates({info.name: accepted} if accepted is not None else {})
    rows = {"performances": info.performances, "frame rate": _rate(info.fps)}
    limits = "Somebody who does anything else is held in the postures of this action."
    return what, rows, held_out, _tracking(f"--method constrained --action {call}"), limits


def _bank(bank: ActionBank, call: str) -> _Told:
    info = bank.info
    what = (
        f"Postures of {len(info.names)} actions, {_listed(info.names)}, and one state for none of them. The "
        "constrained particle filter keeps to the postures of the likeliest, and says which it is."
    )
    rows = {"actions": _listed(info.names), "frame rate": _rate(info.fps)}
    limits = (
        "It knows these actions; what is done otherwise is taken for one of them or for none, when the "
        "constraint is released."
    )
    use = _tracking(f"--method constrained --action {call}")
    return what, rows, _gates(info.extra.get("accepted", {})), use, limits


def _body_motion(motion: BodyMotion, call: str) -> _Told:
    info, found = motion.info, motion.info.extra.get("held_out")
    settings = info.extra.get("settings", {})
    n_poses = len(motion.poses.weights)
    what = (
        "How fast position and angles of a body accelerate, how they do on average by pose and velocity, "
        "how the rest of these accelerations correlates, and how velocities decay (Ornstein-Uhlenbeck "
        "processes), how far neck, shoulders and hips shift from rigid "
        f"parts, mean and covariance of the logarithms of bone lengths, and a mixture of {n_poses} Gaussians "
        "over the angles of all parts, half of them mirror images of the others. The Kalman filter over "
        "bodies from keypoints uses it. Every set of recordings counts alike, except that poses have shares "
        "as the roots of durations."
    )
    held_out = ""
    if found:
        held_out = (
            f"Persons who were held out ({found['frames']:,} frames) accelerate "
            f"{found['acceleration']:.2f} times as much as the prior has it. The log density of their poses "
            f"is {found['log_density']:.2f} an angle, that of the persons above "
            f"{found['fitted_log_density']:.2f}."
        )
    rows = {
        "frames": f"{info.n_frames:,}",
        "frame rate of its velocities": _rate(info.fps),
        "settings": ", ".join(f"{key} {value:g}" for key, value in sorted(settings.items())),
    }
    limits = (
        "It knows how these persons moved and what they did. Faster motion is followed late, and poses "
        "unlike theirs are taken for others where cameras see little."
    )
    use = '`BodyTracker(..., method="kalman")` uses the one that comes with the package, "whole-body".'
    if call.endswith(".safetensors"):
        use = (
            f"```console\n$ torchpose track-body cameras.toml cam1.npz cam2.npz --motion {call} --out result"
            f"\n```\n\nWithout it, {use[0].lower() + use[1:]}"
        )
    return what, rows, held_out, use, limits


_DESCRIBED: Mapping[type, Any] = {
    BackConstrainedGPLVM: _manifold,
    LimbConditionals: _limbs,
    ActionSpace: _action,
    ActionBank: _bank,
    BodyMotion: _body_motion,
}


def _gates(accepted: Mapping[str, float]) -> str:
    if not accepted:
        return ""
    shares = ", ".join(f"{100 * share:.0f} % ({name})" for name, share in accepted.items())
    return f"Share of the postures of persons who were held out that pass the gate: {shares}."


def _body_data(info: Any) -> dict[str, Any]:
    origins = sorted({p.partition("#")[0] for p in info.persons})
    names = sorted(p.partition("#")[2] or p for p in info.persons)
    n = len(getattr(info, "sources", ()))
    return {
        "data": _listed(origins) + (f", {n} recordings" if n > 1 else ""),
        "persons": f"{len(names)}: {_listed(names)}" if names else "not stated",
        "actions": _listed(getattr(info, "actions", ())),
        "licence": info.licence or "not stated",
        "command": f"`{info.command}`" if info.command else "",
    }


def _rate(fps: float | None) -> str:
    return "" if fps is None else f"{fps:g} per second"


def _listed(items: Iterable[str]) -> str:
    return ", ".join(items)
