"""Model card of a prior, written from what its file says about itself."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from torchpose._core.files import atomic_path
from torchpose.priors.upper_body import UpperBodyPrior
from torchpose.priors.window import WindowPrior

__all__ = ["card_table", "card_text", "model_card", "write_model_card"]

_MODES = {"pose": "single poses", "causal": "filtered", "full": "smoothed"}


def model_card(prior: UpperBodyPrior, results: Mapping[str, str] | None = None) -> str:
    """Return Markdown text on what a prior is, what it was fitted on, and what it is not good for.

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
    lines = [f"| {name} | {value} |" for name, value in rows.items() if value]
    return "\n".join(["| | |", "|---|---|", *lines])


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
        "sources": _joined(info.sources),
        "persons": f"{len(info.persons)}: {_joined(info.persons)}"
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
    """Errors of the filters that draw, on fewer frames of the same held-out persons."""
    held_out: Mapping[str, Mapping[str, float]] = prior.info.extra.get("held_out_drawn", {})
    errors = ", ".join(
        f"`{mode.replace('_', '-')}` {100 * fmean(persons.values()):.1f}"
        for mode, persons in held_out.items()
    )
    return f"\n\nOver single poses, mean over persons held out, cm: {errors}." if errors else ""


def _held_out(prior: UpperBodyPrior) -> str:
    """Errors on persons held out in turn, for each way of tracking."""
    held_out: Mapping[str, Mapping[str, float]] = prior.info.extra.get("held_out", {})
    if not held_out:
        known = not prior.info.persons or "fine_tuned" in prior.info.extra
        return "" if known else "Not known: no person was held out."
    modes = sorted(held_out, key=list(_MODES).index)
    persons = sorted(held_out[modes[0]])
    rows = [
        [person, *(f"{100 * held_out[mode].get(person, math.nan):.1f}" for mode in modes)]
        for person in persons
    ]
    values = [[100 * value for value in held_out[mode].values()] for mode in modes]
    rows.append(["mean", *(f"{fmean(column):.1f}" for column in values)])
    if len(persons) > 1:
        rows.append(["standard deviation", *(f"{stdev(column):.1f}" for column in values)])
    lines = ["| person | " + " | ".join(_MODES[mode] for mode in modes) + " |"]
    lines.append("|---|" + "---:|" * len(modes))
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return (
        "3D error in cm, after fixed-scale Procrustes on head, neck and shoulders, from head, neck "
        "and hands with 3 pixels of noise. Each person was tracked by the same recipe at half its "
        "size, fitted to others; somebody new can expect the mean, give or take the standard "
        "deviation.\n\n" + "\n".join(lines)
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
    angles = ", ".join(f"|{a}| <= {math.degrees(views[a]):g}°" for a in ("roll", "pitch", "yaw"))
    shifts = ", ".join(f"{t} {views[t][0]:g} to {views[t][1]:g} m" for t in ("tx", "ty", "tz"))
    return f"{angles}, {shifts}"


def _joined(items: Iterable[str]) -> str:
    return "; ".join(items) or "not stated"
