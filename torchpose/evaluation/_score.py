"""Score a prior and a tracker on recordings of one's own, beside the mean pose.

Every recording is seen by the camera of the other evaluations, with Gaussian noise on the keypoints,
and tracked. Errors are 3D distances after fixed-scale Procrustes on head, neck and shoulders. Persons
whom the prior was fitted on are refused: on them it looks better than on anybody else.
"""

from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.checks import check_choice, check_count
from torchpose._core.files import check_output_folder
from torchpose._core.wording import counted
from torchpose.errors import InputError, OverlapError
from torchpose.evaluation._person_recordings import (
    by_person,
    pose_classes,
    read_known_persons,
    spread,
)
from torchpose.evaluation._person_tables import (
    add_persons,
    add_pose_classes,
    mean_error,
    plot_persons,
)
from torchpose.evaluation._report import Report
from torchpose.evaluation._trials import (
    CAMERA,
    MEASURED,
    Trials,
    draw_picture,
    make_test_set,
    track,
)
from torchpose.evaluation._unseen import (
    LEVELS,
    Scored,
    compare,
    log_likelihood,
    mean_pose_errors,
    pooled,
    poses_by_rate,
)
from torchpose.io._recordings import Recording
from torchpose.priors._arms import shipped_arm_prior
from torchpose.priors._upper_body_prior import UpperBodyPrior, load_prior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._estimator_table import METHODS, choose_method, method_options

_SEEN = {"head+hands": MEASURED, "all": UPPER_BODY}


class _PersonScores(NamedTuple):
    """Holds the scores of a person, and whether the neck is of the prior's kind."""

    scored: Scored
    same_neck: bool


def run(
    data: Sequence[str | Path] | str | Path,
    out: str | Path,
    *,
    seed: int = 0,
    progress: bool = True,
    prior: UpperBodyPrior | None = None,
    method: str | None = None,
    joints: Literal["head+hands", "all"] = "head+hands",
    noise_std: float = 3.0,
    every: int = 1,
    curate: bool = True,
    seen: bool = False,
) -> Report:
    """Score a prior and a tracker; writes report.json, report.md and a picture to `out`.

    Args:
        data: folders or files of recordings. out: folder for the results.
        seed: the seed of the noise, and of methods that draw. progress: whether to show bars.
        prior: the prior to score, a name or a file (default kinect-upper-body).
        method: the method of the tracker (default that of torchpose track).
        joints: what the tracker is given: head, neck and hands, or all eight.
        noise_std: the standard deviation of a keypoint, pixels (default 3).
        every: use only each n-th recording of a person.
        curate: leave out of recordings what jumps or is no body, as `torchpose fit` does, and say so.
        seen: score also persons whom the prior, or the prior over arms that comes with the package, was
            fitted on; the report says so.

    Returns:
        The report, with the tables `joints`, `persons` and `pose_classes`.

    Raises:
        InputError: no recordings, or settings out of range. OverlapError: the prior, or the one over
            arms if the method takes it, was fitted on one of the persons. PriorError: another kind of
            hand than the prior's. OutputError: `out` cannot be written.
    """
    _check(method, joints, noise_std, every)
    out = check_output_folder(out)
    prior = load_prior("kinect-upper-body") if prior is None else prior
    recordings, notes = read_known_persons(data, curate)
    scored = {r.person_id for r in recordings}
    usual = _usual(prior, _SEEN[joints])
    in_arms = _known_to_arms(scored, method or usual)
    known = sorted(scored & {*prior.info.persons, *in_arms})
    if not seen:
        prior.check_unseen(scored)
        _check_arms(in_arms)
    persons = {name: group[::every] for name, group in by_person(recordings).items()}
    found = {}
    for name, group in tqdm(persons.items(), disable=not progress, unit="person", desc="score"):
        found[name] = _score(prior, name, group, method, _SEEN[joints], noise_std, seed)
    report = Report("A prior and a tracker on recordings", {
        "prior": prior.info.name, "method": method or f"default ({usual})", "joints": joints, "seed": seed,
        "noise_std": noise_std, "every": every, "curate": curate, "persons the prior was fitted on": known,
        "persons": {name: counted(len(group), "recording") for name, group in persons.items()},
    })  # fmt: skip
    _add_joints(report, found)
    by_name = {name: scores.scored for name, scores in found.items()}
    add_persons(report, by_name)
    add_pose_classes(report, {"all": pooled(list(by_name.values()))})
    _add_findings(report, found, known)
    report.findings += notes
    title = f"3D error of each person under {prior.info.name or 'the prior'}"
    draw_picture(report, out, "persons.png", lambda: plot_persons(by_name, title))
    report.save(out)
    return report


def _check(method: str | None, joints: str, noise_std: float, every: int) -> None:
    if method is not None:
        check_choice("method", method, METHODS)
    check_choice("joints", joints, _SEEN)
    if not 0 < noise_std < float("inf"):
        raise InputError(f"noise_std must be positive, got {noise_std:g}")
    check_count("every", every)


def _usual(
    prior: UpperBodyPrior,
    names: Sequence[str],
    fps: float | None = None,
    smoothing: str | None = None,
) -> str:
    """Return the default method of the tracker for these joints."""
    there = [joint in names for joint in UPPER_BODY]
    return choose_method(prior, None, smoothing, fps, ()).with_joints(there, wrists=False)


def _known_to_arms(persons: Set[str], method: str) -> list[str]:
    """Return the persons on whom the prior over arms was fitted, if the method uses it."""
    if "arms" not in method_options(method):
        return []
    return sorted(persons & set(shipped_arm_prior().info.persons))


def _check_arms(known: Sequence[str]) -> None:
    """Raise `OverlapError` if there are persons to whom the prior over arms was fitted."""
    if known:
        raise OverlapError(
            f"the prior over arms that comes with the package was fitted on {', '.join(known)}; score "
            "other persons, pass seen=True (--seen true), or take method 'window-mixture' or 'mkf-fixed', "
            "which do without it"
        )


def _score(
    prior: UpperBodyPrior,
    name: str,
    recordings: Sequence[Recording],
    method: str | None,
    names: tuple[str, ...],
    noise_std: float,
    seed: int,
) -> _PersonScores:
    """Track the recordings of a person, filtered and, where the method can, smoothed, at their own rates.

    A neck of another kind than the prior's is neither measured nor scored, as there is no telling
    where the prior would have it.
    """
    same_neck = all(r.upper_body().neck == prior.info.neck for r in recordings)
    left_out = () if same_neck else ("neck",)
    names = tuple(joint for joint in names if joint not in left_out)
    counted = torch.tensor([joint not in left_out for joint in UPPER_BODY])
    parts = []
    for fps, poses in poses_by_rate(recordings, prior, None, name).items():
        test = make_test_set(poses, CAMERA, fps, seed, noise_std, names=names)
        filtered, inside = _tracked(prior, test, counted, method, seed)
        smoothed = torch.full_like(filtered, torch.nan)
        if method is None or METHODS[method].smooths:
            smoothed, _ = _tracked(prior, test, counted, method, seed, smoothing="full")
        truth = torch.cat(poses).double()
        likelihood = torch.full((len(truth),), torch.nan, dtype=torch.float64)
        if same_neck:
            likelihood = log_likelihood(prior, truth, seed)
        parts.append(Scored(
            filtered.float(), smoothed.float(), inside.float(), likelihood, pose_classes(truth),
            mean_pose_errors(prior, truth, counted),
        ))  # fmt: skip
    return _PersonScores(pooled(parts), same_neck)


def _tracked(
    prior: UpperBodyPrior,
    test: Trials,
    counted: Bool[Tensor, " 8"],
    method: str | None,
    seed: int,
    **options: Any,
) -> tuple[Tensor, Tensor]:
    """Return errors [N, 8] and whether the truth is inside the ellipsoids [N, L, 8]."""
    generator = torch.Generator().manual_seed(seed)
    method = method or _usual(prior, test.names, test.fps, options.get("smoothing"))
    estimate = track(prior, CAMERA, test, method=method, generator=generator, **options)
    return compare(estimate, test, counted)


# --- the report -----------------------------------------------------------------------------------


def _add_joints(report: Report, found: Mapping[str, _PersonScores]) -> None:
    """Add a row for each joint: errors beside those of the mean pose, and coverage."""
    table = report.table(
        "joints",
        "3D error after Procrustes (cm) and true joints inside the ellipsoids (%), by joint",
        ["mean pose", "filtered", "smoothed", "in 50 %", "in 90 %"],
        digits=(2, 2, 2, 0, 0),
        note="All frames of all persons. The mean pose is that of the prior; a tracker that is no "
        "better than it has learnt nothing from the keypoints.",
    )
    everybody = pooled([scores.scored for scores in found.values()])
    errors = [everybody.still, everybody.filtered, everybody.smoothed]
    for j, joint in enumerate(UPPER_BODY):
        means = [100 * float(e[:, j].double().nanmean()) for e in errors]
        inside = (100 * everybody.inside[:, :, j].double().nanmean(0)).tolist()
        table.add(joint.replace("_", " "), [*means, *inside])
    means = [100 * float(e.double().nanmean()) for e in errors]
    inside = (100 * everybody.inside.double().nanmean((0, 2))).tolist()
    table.add("all joints", [*means, *inside])


def _add_findings(report: Report, found: Mapping[str, _PersonScores], known: Sequence[str]) -> None:
    errors = [mean_error(scores.scored) for scores in found.values()]
    still = [mean_error(scores.scored, "still") for scores in found.values()]
    (mean, wide), (base, _) = spread(errors), spread(still)
    persons = counted(len(found), "person")
    deviation = f" ± {wide:.2f}" if len(found) > 1 else ""
    report.findings.append(
        f"Over {persons}: {mean:.2f}{deviation} cm filtered; the mean pose of the prior is "
        f"{base:.2f} cm off."
    )
    table: Any = report["joints"]
    levels = ", ".join(
        f"{table['all joints', f'in {100 * level:.0f} %']:.0f} % in those of {100 * level:.0f} %"
        for level in LEVELS
    )
    report.findings.append(f"True joints inside the filter's ellipsoids: {levels}.")
    others = [name for name, scores in found.items() if not scores.same_neck]
    if others:
        report.findings.append(
            f"The neck of {', '.join(others)} is of another kind than the prior's: it is neither "
            "measured nor scored, nor aligned on."
        )
    if known:
        report.findings.append(
            f"The prior was fitted on {', '.join(known)}: these errors are not what anybody else can "
            "expect."
        )
