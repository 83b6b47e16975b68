"""Arms of strangers: methods with and without bones beside elementary geometry.

Error: the vector from the shoulder to the wrist (or hand) of the same side, in camera axes, so that
nothing is aligned.

- Berkeley MHAD is seen by one camera with 3 px of noise at 2.5 m.
- The four views of a balancing person (Pose2Sim) are OpenPose's keypoints of the upper body, one camera at
  a time, against its triangulation.
- Clips of strangers at webcams are MediaPipe's 2D against its own 3D landmarks, which are a network's and
  no truth.
- Persons s7 and s8 of UTD-MHAD are seen by the test camera of UB-people.

The prior over arms is fitted without the set that is scored, for UTD-MHAD without these two persons. The
other methods have the prior that comes with torchpose, which knows none of these persons; for UTD-MHAD one
that is fitted to s1 to s6 as in UB-people.

    python -m benchmarks.bones --data DIR [--out FILE] [--pictures FOLDER]
    python -m benchmarks.bones --data DIR --fit FILE.safetensors

The second line fits the prior over arms that comes with torchpose, to all sets.

Lifts put elbow and wrist on the rays of their pixels at the depth that the length of the bone leaves,
all forward; with the person's own lengths they know what a tracker has to find out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import torchpose
from benchmarks._command import run_command
from benchmarks._table_file import TableFile
from torchpose._core.files import check_output_folder
from torchpose.evaluation import Report
from torchpose.evaluation.common import CAMERA, centred_on_neck, make_test_set
from torchpose.io import Recording, read_recordings
from torchpose.learning import fit_kinect_prior
from torchpose.learning._arms import fit_arm_prior
from torchpose.metrics import coverage
from torchpose.priors import UpperBodyPrior
from torchpose.priors._arms import ArmPrior, shipped_arm_prior
from torchpose.skeleton import UPPER_BODY
from torchpose.skeleton._joint_sets import canonical_names
from torchpose.upper_body._face import FACE

SETS = {
    "kinect_utd_mhad": 0.4,
    "burke_kinect/kinect_joints.npz": 0.12,
    "kinect_laban": 0.08,
    "mocap_berkeley_mhad": 0.25,
    "mocap_cmu_actions": 0.12,
    "mocap_cmu_walk": 0.03,
}
"""Share of each set in the fit of a prior over arms."""

_DIGITS = (1, 1, 0, 1, 0, 0)
COLUMNS = (
    "wrist (cm)",
    "elbow (cm)",
    "elbow before or behind (%)",
    "spread of the forearm (%)",
    "inside 50 %",
    "inside 90 %",
)
_SEVEN = ("wrist_left", "elbow_left", "shoulder_left", "neck", "shoulder_right", "elbow_right",
          "wrist_right")  # fmt: skip
_MHAD = ("left_wrist", "left_elbow", "left_shoulder", "neck", "right_shoulder", "right_elbow",
         "right_wrist")  # fmt: skip
_OPENPOSE_FACE = ("Nose", "LEye", "REye", "LEar", "REar")
_PLACE, _EVERY, _FRAMES, _STD = (0.05, -0.2, 2.5), 15, 150, 3.0
FEW = (0, 3, 6)  # neck and wrists
_KINECT = (*(name.replace("wrist", "hand") for name in _SEVEN), "head")
FOUR = (0, 3, 6, 7)  # neck, hands and head
_UTD, _UTD_PERSONS, _UTD_EVERY = "kinect_utd_mhad", ("s7", "s8"), 8
FIT = {"n_components": 10, "window_components": 48, "calibration_folds": 0}
_NAMES = ("mhad", "openpose", "webcam", "utd-mhad")  # of groups, for pictures
_VISIBLE, _UNSEEN = 0.6, 0.3  # MediaPipe's visibility: of an arm that is scored, of a missing joint
_QUICK_FRAMES = 20  # of a view of a quick run
_SETTLED = 90  # frames, from where on the spread of a bone's length counts


def arm_rows(names: Sequence[str]) -> list[list[int]]:
    """Return the places of shoulder, elbow and wrist, or else hand, of left and right among joints."""
    known = canonical_names(names)
    end = "wrist" if "wrist_left" in known else "hand"
    return [[known.index(f"{joint}_{side}") for joint in ("shoulder", "elbow", end)]
            for side in ("left", "right")]  # fmt: skip


ENDS = arm_rows(UPPER_BODY)


class View(NamedTuple):
    """A recording seen by one camera.

    Attributes:
        keypoints: [T, J, 2], NaN where missing, in the order of `names`. confidence: [T, J].
        names: of the keypoints. camera: of the pixels. neck: kind of the keypoints' neck.
        truth: of left and right: shoulder, elbow, wrist, camera axes, [T, 2, 3, 3].
        fps: frames per second. depth: of the shoulders, metres; None is that of the truth.
    """

    keypoints: Tensor
    confidence: Tensor
    names: Sequence[str]
    camera: torchpose.PinholeCamera
    neck: str
    truth: Tensor
    fps: float
    depth: float | None = None

    @property
    def far(self) -> float:
        """Return the depth of the shoulders, metres."""
        return float(self.truth[..., 0, 2].nanmean()) if self.depth is None else self.depth


class Chains(NamedTuple):
    """Vectors from the shoulder to the elbow and on to the wrist, [T, 2, 3] each.

    Attributes:
        inside: shares of true elbows and wrists in the 50 % and the 90 % ellipsoids, NaN without any.
    """

    upper: Tensor
    lower: Tensor
    inside: Sequence[float] = (float("nan"), float("nan"))


def mhad_views(data: Path, every: int = _EVERY) -> list[View]:
    """Return one recording in fifteen of Berkeley MHAD, 150 frames each, in a camera at 2.5 m.

    Args:
        data: folder with mocap_berkeley_mhad/. every: one recording in so many.
    """
    camera = torchpose.PinholeCamera(525.0, 525.0, 319.5, 239.5)
    rng = np.random.default_rng(0)
    views = []
    for path in sorted((data / "mocap_berkeley_mhad").rglob("*.npz"))[7::every]:
        with np.load(path) as file:
            names = [str(name) for name in file["names"]]
            picked = [names.index(name) for name in _MHAD]
            joints = file["joints"][:_FRAMES, picked].astype(float) * np.array([1, -1, -1.0])
        joints = joints - joints[:, [3]] + np.array(_PLACE)
        pixels = joints[..., :2] / joints[..., 2:] * 525 + np.array([319.5, 239.5])
        pixels = torch.tensor(pixels + rng.normal(0, _STD, pixels.shape))
        truth = torch.tensor(joints)[:, arm_rows(_SEVEN)]
        views.append(
            View(pixels, torch.ones(pixels.shape[:2]), _SEVEN, camera, "mid-shoulder", truth, 30.0)
        )
    return views


def openpose_views(data: Path) -> list[View]:
    """Return the balancing person in each of four cameras, as OpenPose saw the upper body.

    Args:
        data: folder with multicam_pose2sim/.
    """
    views = []
    for path in sorted((data / "multicam_pose2sim").rglob("*.npz")):
        with np.load(path) as file:
            if "openpose_2d" not in file:
                continue
            arrays = {key: file[key] for key in file.files}
        ends = arm_rows([str(name) for name in arrays["names"]])
        seen = [str(name) for name in arrays["openpose_names"]]
        limbs = ("Wrist", "Elbow", "Shoulder")
        wanted = [f"L{limb}" for limb in limbs] + ["Neck"] + [f"R{limb}" for limb in limbs[::-1]]
        for k, rotation, t, found in zip(
            *(arrays[key] for key in ("K", "R", "t", "openpose_2d")), strict=True
        ):
            world = arrays["joints"].astype(float)[:, ends]
            truth = torch.tensor(world @ np.asarray(rotation, float).T + np.ravel(t))
            keypoints = torch.tensor(
                found[:, [seen.index(name) for name in (*wanted, *_OPENPOSE_FACE)]],
                dtype=torch.float64,
            )
            sure = keypoints[..., 2].clamp(0, 1)
            camera = torchpose.PinholeCamera(
                float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
            )
            fps = float(arrays["fps"])
            views.append(
                View(keypoints[..., :2], sure, (*_SEVEN, *FACE), camera, "mid-shoulder", truth, fps)
            )
    return views


def webcam_views(data: Path) -> list[View]:
    """Return clips of strangers as MediaPipe saw them, with its own 3D landmarks in place of a truth.

    Frames in which it is not sure of an arm have no truth. Clips without a visible arm are left out. The
    depth is the one at which the shoulders have the size of the image; hands are nearer.

    Args:
        data: folder with video_people/ and video_asl/.
    """
    views = []
    folders = (data / name for name in ("video_people", "video_asl"))
    for path in (p for folder in folders for p in sorted(folder.glob("*_mediapipe_pose1.npz"))):
        with np.load(path) as file:
            arrays = {key: file[key] for key in file.files}
        names = [str(name) for name in arrays["names"]]
        kept = [i for i, name in enumerate(names) if not name.endswith(("hip", "index"))]
        ends = arm_rows(names)
        sure = torch.tensor(arrays["visibility"]).double().clamp(0, 1)
        keypoints = torch.tensor(arrays["joints2d"]).double()
        truth = torch.tensor(arrays["joints3d"]).double()[:, ends]
        widths = [
            arms[:, :, 0, :2].diff(dim=1).norm(dim=-1) for arms in (truth, keypoints[:, ends])
        ]
        truth[(sure[:, ends] < _VISIBLE).any(-1)] = torch.nan
        if not bool(truth.isfinite().any()):
            continue
        camera = torchpose.PinholeCamera.from_image_size(*(int(x) for x in arrays["image_size"]))
        depth = float((widths[0] / widths[1]).nanmedian() * camera.matrix[0, 0])
        sure, fps = torch.where(sure < _UNSEEN, 0.0, sure)[:, kept], float(arrays["fps"])
        seen = [names[i] for i in kept]
        views.append(
            View(keypoints[:, kept], sure, seen, camera, "mid-shoulder", truth, fps, depth)
        )
    return views


@cache
def recordings(folder: Path) -> list[Recording]:
    """Return the recordings of a set, read once."""
    return read_recordings(folder)


def kinect_views(data: Path, every: int = _UTD_EVERY) -> list[View]:
    """Return sequences of s7 and s8 of UTD-MHAD in the test camera of UB-people, 3 px of noise.

    Args:
        data: folder with kinect_utd_mhad/. every: one sequence in so many.
    """
    chosen = [r for r in recordings(data / _UTD) if r.person in _UTD_PERSONS][::every]
    return seen_by_camera([r.upper_body().joints.double() for r in chosen])


def seen_by_camera(joints: Sequence[Float[Tensor, "T 8 3"]]) -> list[View]:
    """Return recordings in the test camera of UB-people, 3 px of noise.

    Args:
        joints: of each, at 30 frames a second.
    """
    poses = [centred_on_neck(x) for x in joints]
    test = make_test_set(poses, CAMERA, 30.0, noise_std=_STD, names=_KINECT)
    views = []
    for keypoints, truth, n in zip(
        test.keypoints, test.truth3d, test.lengths.tolist(), strict=True
    ):
        sure = torch.ones(n, len(_KINECT))
        views.append(View(keypoints[:n], sure, _KINECT, CAMERA, "neck", truth[:n][:, ENDS], 30.0))
    return views


def fit_without(data: Path, left_out: str | None, persons: Sequence[str] = ()) -> ArmPrior:
    """Return the prior over arms that is fitted to all sets but one, and without some persons.

    Args:
        data: folder with the sets. left_out: name of a set, None for none. persons: left out of all
            sets.
    """
    kept = {name: share for name, share in SETS.items() if name != left_out}
    found = [[r for r in recordings(data / name) if r.person not in persons] for name in kept]
    return fit_arm_prior(found, shares=list(kept.values()))


def fit_shipped(data: Path, path: Path) -> None:
    """Fit the prior over arms to all sets, and write it."""
    fitted = fit_without(data, None)
    info = replace(
        fitted.info,
        name="upper-body-arms",
        sources=tuple(name.split("/")[0] for name in SETS),
        licence="MIT; see the card for the recordings",
        command=f"python -m benchmarks.bones --data DIR --fit {path.name}",
    )
    fitted = ArmPrior(
        fitted.directions.rounded(), fitted.lengths, fitted.spread, fitted.broad, info,
        fitted.together.float(),
    )  # fmt: skip
    fitted.save(path)


def tracked(
    view: View, prior: UpperBodyPrior, chosen: Sequence[int] | None, **options: object
) -> Chains:
    """Return the chains of a tracker.

    Args:
        view: what is seen. prior: of the tracker. chosen: keypoints that are measured, None for all.
        options: of the tracker.
    """
    poses = poses_of(view, prior, chosen, **options)
    ends = poses.joints3d[0][:, ENDS]
    covariance = poses.covariance3d[0][:, ENDS]
    found, true = (x - x[:, :, :1].mean(1, keepdim=True) for x in (ends, view.truth))
    parts = (x[:, :, 1:].flatten(1, 2) for x in (found, covariance, true))
    bones = ends.diff(dim=2)
    return Chains(bones[:, :, 0], bones[:, :, 1], coverage(*parts).overall.tolist())


def poses_of(
    view: View, prior: UpperBodyPrior, chosen: Sequence[int] | None, **options: object
) -> torchpose.PoseTrack:
    """Return the poses of a tracker; see `tracked`."""
    rows = list(range(len(view.names))) if chosen is None else list(chosen)
    tracker = torchpose.UpperBodyTracker(
        prior, view.camera, neck=view.neck, fps=view.fps, max_gap=None, **options
    )  # type: ignore[arg-type]
    with torch.inference_mode():
        return tracker(
            view.keypoints[None, :, rows],
            view.confidence[None, :, rows].double(),
            names=[view.names[i] for i in rows],
        )


def lifted(view: View, lengths: Float[Tensor, "2 2"], depth: float) -> Chains:
    """Return arms in front of the image plane through the shoulders, at one depth.

    Args:
        view: what is seen. lengths: of upper arm and forearm, left and right. depth: of the body.
    """
    matrix = view.camera.matrix
    focal = torch.stack([matrix[0, 0], matrix[1, 1]])
    flat = view.keypoints[:, arm_rows(view.names)] / focal * depth
    bones = flat.diff(dim=2)
    away = (lengths.square() - bones.square().sum(-1)).clamp_min(0).sqrt()
    whole = torch.cat([bones, -away[..., None]], -1)
    return Chains(whole[:, :, 0], whole[:, :, 1])


def errors(chains: Chains, truth: Float[Tensor, "T 2 3 3"]) -> list[float]:
    """Return a row of a method: two errors, share of right signs, a bone's spread, and coverages."""
    upper, lower = truth[:, :, 1] - truth[:, :, 0], truth[:, :, 2] - truth[:, :, 1]
    wrist = (chains.upper + chains.lower - upper - lower).norm(dim=-1).nanmean()
    elbow = (chains.upper - upper).norm(dim=-1).nanmean()
    known = upper[..., 2].isfinite()
    sign = (chains.upper[..., 2] * upper[..., 2] > 0)[known].double().mean()
    length = chains.lower.norm(dim=-1)[_SETTLED:] if len(upper) > _SETTLED + 10 else None
    spread = torch.nan
    if length is not None:
        spread = float((length.std(0) / length.mean(0)).mean())
    inside = [100 * share for share in chains.inside]
    return [100 * float(wrist), 100 * float(elbow), 100 * float(sign), 100 * spread, *inside]


def true_lengths(view: View) -> Float[Tensor, "2 2"]:
    """Return the mean lengths of upper arm and forearm of left and right."""
    return view.truth.diff(dim=2).norm(dim=-1).nanmean(0)


def trackers(arms: ArmPrior) -> dict[str, dict[str, object]]:
    """Return the options of the trackers that are compared, by the method's name."""
    own = {"window-mixture": {}, "articulated": {"arms": arms}, "multiple-model": {"arms": arms},
           "mkf-fixed": {}}  # fmt: skip
    return {name: {"method": name, **options} for name, options in own.items()}


def lifts(mean: Float[Tensor, "2 2"]) -> dict[str, Callable[[View], Chains]]:
    """Return the methods that need no tracker, by name.

    Args:
        mean: lengths of other persons.
    """

    def mean_arm(view: View) -> Chains:
        hanging = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        upper, lower = (mean[:, i, None] * hanging for i in (0, 1))
        return Chains(*(bone.expand(len(view.truth), 2, 3) for bone in (upper, lower)))

    return {
        "lift, own lengths and depth": lambda v: lifted(v, true_lengths(v), v.far),
        "lift, others' lengths, own depth": lambda v: lifted(v, mean, v.far),
        "hanging arms": mean_arm,
    }


class Group(NamedTuple):
    """Views that are scored together.

    Attributes:
        seen: what they are, for the title. views: of them.
        left_out, persons: of the fit of arms (`fit_without`); of the persons' own set the prior of the
            other trackers is fitted to everybody else.
        each: whether each view has rows of its own.
        few: keypoints that are measured in one more table. few_seen: what these are.
    """

    seen: str
    views: Sequence[View]
    left_out: str | None = None
    persons: Sequence[str] = ()
    each: bool = False
    few: Sequence[int] = ()
    few_seen: str = ""


def groups(data: Path, quick: bool) -> Iterator[Group]:
    """Yield the groups of views to score, set by set; few views of each in a quick run."""
    for group in _groups(data, quick):
        views = [begun(view) for view in group.views] if quick else group.views
        yield group._replace(views=views)


def begun(view: View, frames: int = _QUICK_FRAMES) -> View:
    """Return the first frames of a view."""
    seen = (view.keypoints, view.confidence, view.truth)
    keypoints, confidence, truth = (values[:frames] for values in seen)
    return view._replace(keypoints=keypoints, confidence=confidence, truth=truth)


def _groups(data: Path, quick: bool) -> Iterator[Group]:
    every = 150 if quick else _EVERY
    yield Group("MHAD, seven joints", mhad_views(data, every), "mocap_berkeley_mhad",
                few=FEW, few_seen="MHAD, neck and wrists")  # fmt: skip
    yield Group("OpenPose, upper body and face, one of four views",
                openpose_views(data)[: 1 if quick else None], each=True)  # fmt: skip
    yield Group("Webcams, MediaPipe's 2D against its own 3D landmarks",
                webcam_views(data)[: 1 if quick else None])  # fmt: skip
    every = 200 if quick else _UTD_EVERY
    yield Group("UTD-MHAD, eight joints", kinect_views(data, every), persons=_UTD_PERSONS,
                few=FOUR, few_seen="UTD-MHAD, head, neck and hands")  # fmt: skip


def priors_of(group: Group, data: Path, quick: bool) -> tuple[UpperBodyPrior, ArmPrior]:
    """Return the priors of a group, which know nobody in it; of a quick run those at hand."""
    if quick:
        return torchpose.load_prior("kinect-upper-body-small"), shipped_arm_prior()
    known = group.left_out is not None or group.persons
    arms = fit_without(data, group.left_out, group.persons) if known else shipped_arm_prior()
    if not group.persons:
        return torchpose.load_prior("kinect-upper-body"), arms
    others = [r for r in recordings(data / _UTD) if r.person not in group.persons]
    return fit_kinect_prior(others, seed=0, **FIT), arms


def add_group(report: Report, group: Group, prior: UpperBodyPrior, arms: ArmPrior) -> None:
    """Add the tables of a group: all keypoints measured, and few."""

    def rows(method: Callable[[View], Chains]) -> Float[Tensor, "V 6"]:
        return torch.tensor([errors(method(view), view.truth) for view in group.views])

    def of_trackers(chosen: Sequence[int] | None) -> dict[str, Tensor]:
        return {
            name: rows(partial(tracked, prior=prior, chosen=chosen, **options))
            for name, options in trackers(arms).items()
        }

    def measured_first(view: View) -> Chains:
        upper, lower = true_lengths(view).nanmean(0).tolist()
        own = {"upper_arm": upper, "forearm": lower}
        return tracked(view, prior, None, **trackers(arms)["articulated"], bone_lengths=own)

    table = report.table(group.seen, group.seen, COLUMNS, digits=_DIGITS)
    smoothed = {
        f"{name}, smoothed": rows(
            partial(tracked, prior=prior, chosen=None, smoothing="full", **own)
        )
        for name, own in trackers(arms).items()
    }
    own_lengths = {"articulated, own lengths of arms": rows(measured_first)}
    found = of_trackers(None) | own_lengths | smoothed
    others = {name: rows(lift) for name, lift in lifts(arms.lengths[:2].expand(2, 2)).items()}
    for name, scored in (found | others).items():
        table.add(name, scored.nanmean(0))
    for i in range(len(group.views) if group.each else 0):
        for name, scored in found.items():
            table.add(f"view {i + 1}, {name}", scored[i])
    if group.few:
        table = report.table(group.few_seen, group.few_seen, COLUMNS, digits=_DIGITS)
        for name, scored in of_trackers(group.few).items():
            table.add(name, scored.nanmean(0))


def draw(group: Group, prior: UpperBodyPrior, arms: ArmPrior, folder: Path, name: str) -> None:
    """Write strips of the last view of a group: windows and bones, with the truth in grey.

    The truth is moved so that the middles of the shoulders meet.
    """
    from torchpose import viz

    view = group.views[-1]
    for method in ("window-mixture", "articulated"):
        poses = poses_of(view, prior, None, **trackers(arms)[method])
        joints = poses.joints3d[0]
        truth = torch.full_like(joints, torch.nan)
        truth[:, ENDS] = view.truth
        middles = (x[:, ENDS][:, :, 0].mean(1, keepdim=True) for x in (joints, truth))
        found, true = middles
        figure = viz.plot_pose_strip(
            joints, truth=truth + found - true, fps=view.fps, observed=poses.observed[0],
            title=f"{group.seen}: {method}",
        )  # fmt: skip
        viz.save_figure(figure, folder / f"{name}-{method}.png", dpi=110)


def main(
    *,
    data: Path,
    threads: int = 2,
    out: TableFile | None = None,
    quick: bool = False,
    pictures: Path | None = None,
    fit: Path | None = None,
) -> None:
    """Print the tables.

    Args:
        data: folder with the sets.
        threads: cores.
        out: file for the same as Markdown, or a folder.
        quick: few recordings, to see that it works.
        pictures: folder for strips of poses.
        fit: file for a prior over arms, in place of the table.
    """
    torch.set_num_threads(threads)
    if fit is not None:
        fit_shipped(data, fit)
        return
    if pictures is not None:
        check_output_folder(pictures)
    report = Report("Arms of strangers")
    for group, name in zip(groups(data, quick), _NAMES, strict=True):
        priors = priors_of(group, data, quick)
        if pictures is not None:
            draw(group, *priors, pictures, name)
        add_group(report, group, *priors)
    tables = [table.to_markdown() for table in report.values()]
    print("\n\n".join(tables))
    if out is not None:
        out.write_text("\n\n".join(tables) + "\n")


if __name__ == "__main__":
    run_command(main)
