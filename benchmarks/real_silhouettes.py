"""Real silhouettes: four cameras around a balancing man, and one depth camera before eight persons.

The four views (`multicam_pose2sim`) are silhouettes of its videos against pictures of the empty room,
made by `torchpose.video._silhouettes`; the reference is the set's triangulated 3D, which no marker
measured, so the table is a difference and not an error. The single view (`utd_mhad_silhouettes`) is
segmented depth, paired with the Kinect's skeleton at the lag that the set gives; body, noise and
manifold come from other recordings than the one that is tracked, sharpness from another person. A
single view does not show how far away somebody is: errors are given with and without the place of
the pelvis.

It writes real-silhouettes.md and the folder real-silhouettes of its pictures into the folder of the
results.

    python -m benchmarks.real_silhouettes --data DIR --out DIR
"""

import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._command import run_command
from benchmarks._depth_silhouettes import (
    Filmed,
    draw,
    fit_to_view,
    kinect,
    mean_of,
    one_view,
    part_means,
    seeded,
)
from benchmarks._table_file import save_text
from benchmarks.bodies.tracking import PARTS
from benchmarks.silhouette.filters import METHODS
from torchpose._core.files import check_output_folder
from torchpose._core.reading import read_npz
from torchpose.body import BODY_15, Body, JointLimits, body_joints, fit_body, fit_state
from torchpose.camera import CameraRig, load_cameras
from torchpose.evaluation import Report
from torchpose.learning import fit_gplvm, fit_gplvm_noise
from torchpose.priors import BackConstrainedGPLVM, ManifoldInfo
from torchpose.video import SilhouetteMeasurer, open_video, read_silhouettes
from torchpose.video._silhouettes import fit_views, read_empty_scene
from torchpose.whole_body import (
    AnnealedParticleFilter,
    ManifoldParticleFilter,
    SilhouetteParticleFilter,
    SIRParticleFilter,
    find_pose,
    motion_std,
)

ROWS = 160
HEIGHT = 1.75  # metres, of the man in the four views: nobody wrote it down
N_PARTICLES, LAYERS = 1000, 5
SHARPNESS = (30.0, 100.0, 300.0)
ACTIONS = ("wave", "arm_curl", "squat", "lunge")
TEST, TUNING, OTHERS = ("s02", "s04", "s06"), "s08", ("s01", "s03", "s05", "s07")
DRAWN = ("squat", "s02", METHODS["mrpf"].label)
PICTURES = "real-silhouettes"
Make = Callable[[float], SilhouetteParticleFilter]


# --- four cameras


def four_views(folder: Path) -> Filmed:
    """Return the silhouettes of the videos, and the set's triangulated 3D."""
    raw = folder / "multicam_pose2sim" / "raw"
    cameras = list(load_cameras(raw / "Calib_qualisys.toml").values())
    sources = [open_video(raw / f"cam{i:02d}.mp4") for i in range(1, 5)]
    views = fit_views(cameras, [source.size for source in sources], ROWS)
    measurers = []
    for i, (view, source) in enumerate(zip(views, sources, strict=True), start=1):
        empty = read_empty_scene(raw / f"cam{i:02d}_ext.png")
        frames = [frame.image for frame in source.reopen() if frame.index % 4 == 0]
        measurers.append(SilhouetteMeasurer(view, empty, frames))
    silhouettes = torch.stack(list(read_silhouettes(sources, measurers)))
    for source in sources:
        source.close()
    arrays = read_npz(folder / "multicam_pose2sim" / "balancing_4cam.npz")
    joints = body_joints(torch.from_numpy(arrays["joints"]).double(), list(arrays["names"]))
    n = min(len(silhouettes), len(joints))
    return Filmed(silhouettes[:n], CameraRig([v.camera for v in views]), joints[:n])


def facing(joints: Tensor) -> Tensor:
    """Return the horizontal direction in which the person of a frame looks, z up."""
    left = joints[BODY_15.joint("left_shoulder")] - joints[BODY_15.joint("right_shoulder")]
    return torch.linalg.cross(left, torch.tensor([0.0, 0.0, 1.0], dtype=left.dtype))


def report_four(report: Report, folder: Path, seeds: int, out: Path) -> None:
    """Add the difference from the triangulated 3D, from a given first pose and from one that is found."""
    data = four_views(folder)
    table = report.table(
        "four", "Four cameras: distance from the triangulated 3D (mm)", ["all", *PARTS],
        note=f"{len(data.joints)} frames at 60 Hz, {N_PARTICLES} particles in all, untuned (sharpness "
        f"100, survival rate 0.5), body of average proportions, {HEIGHT} m; mean of {seeds} seeds. "
        "The set's head is the top of the head, this body's the middle.",
    )  # fmt: skip
    average = Body.of_height(BODY_15, HEIGHT)
    own = fit_body(data.joints, head_top=0.0)
    for body, shape in ((average, "average body"), (own, "own bone lengths")):
        given = fit_state(body, data.joints[:1])[0]
        for name, make in plain_filters(body, None).items():
            found = [
                body.joints(
                    make(100.0)(data.silhouettes, data.rig, given, generator=seeded(seed)).mean
                )
                for seed in range(seeds)
            ]
            table.add(f"{name}, {shape}", mean_of(found, data.joints, False))
    given = fit_state(average, data.joints[:1])[0]
    track = plain_filters(average, None)["APF"](100.0)(
        data.silhouettes, data.rig, given, generator=seeded(0)
    )
    draw(report, data, average, track.mean, out, f"{PICTURES}/four-cameras.png")
    tracks = []
    for seed in range(seeds):
        generator = seeded(seed)
        start = find_pose(
            average, data.silhouettes[0], data.rig, None, generator, facing=facing(data.joints[0])
        )
        tracker = plain_filters(average, None)["APF"](100.0)
        tracks.append(
            average.joints(tracker(data.silhouettes, data.rig, start, generator=generator).mean)
        )
    table.add("APF, average body, first pose found", mean_of(tracks, data.joints, False))


def plain_filters(
    body: Body, process_cov: Tensor | None, limits: JointLimits | None = None
) -> dict[str, Make]:
    """Return SIR and the annealed filter, with equally many likelihoods a frame."""
    return {
        "SIR": lambda s: SIRParticleFilter(
            body, N_PARTICLES, process_cov=process_cov, sharpness=s, limits=limits
        ),
        "APF": lambda s: AnnealedParticleFilter(
            body, N_PARTICLES // LAYERS, n_layers=LAYERS, process_cov=process_cov, limits=limits
        ),
    }


# --- one camera


class Person(NamedTuple):
    """Body, noise and manifold from other trials than the tracked one, and from other persons."""

    body: Body
    step_std: Tensor
    manifold: BackConstrainedGPLVM
    limits: JointLimits


def prepare(folder: Path, person: str, action: str) -> Person:
    """Fit bone lengths to trials 2 to 4, radii to another action's silhouettes, and a manifold to others."""
    own = list(kinect(folder, person, action, "234"))
    body = fit_to_view(own, one_view(folder, person, "clap" if action != "clap" else "wave"))
    poses = [
        body.relative(fit_state(body, joints))
        for p in OTHERS
        for joints in kinect(folder, p, action, "2")
    ]
    info = ManifoldInfo.of_body(body, name=f"{action} of {', '.join(OTHERS)}")
    manifold = fit_gplvm(poses, seed=0, info=info)
    validation = [
        body.relative(fit_state(body, joints)) for joints in kinect(folder, TUNING, action, "23")
    ]
    manifold = fit_gplvm_noise(manifold, validation, 30.0)
    std = motion_std(body, [fit_state(body, joints) for joints in own], floor=1e-3)
    seen = [fit_state(body, j) for p in OTHERS for a in ACTIONS for j in kinect(folder, p, a, "2")]
    return Person(body, std, manifold, JointLimits.fit(torch.cat(seen)))


def filters_of(person: Person) -> dict[str, Make]:
    """Return all filters with the same noise and limits; the manifold's exact and as published."""
    common = {"process_cov": person.step_std.square(), "limits": person.limits}

    def with_manifold(options: dict[str, str]) -> Make:
        return lambda s: ManifoldParticleFilter(
            person.body, person.manifold, N_PARTICLES, sharpness=s, **common, **options
        )

    return plain_filters(person.body, person.step_std.square(), person.limits) | {
        METHODS[name].label: with_manifold(METHODS[name].options)
        for name in ("mrpf", "mrpf-published")
    }


def run(person: Person, make: Make, sharpness: float, data: Filmed, seed: int) -> Tensor:
    """Return the joints of the estimates [T, 15, 3]."""
    start = fit_state(person.body, data.joints[:1])[0]
    track = make(sharpness)(data.silhouettes, data.rig, start, generator=seeded(seed))
    return person.body.joints(track.mean)


def report_one(report: Report, folder: Path, seeds: int, actions: Sequence[str], out: Path) -> None:
    """Add the error of a single view, for each action."""
    centred = report.table(
        "one", "One depth camera: error without the place of the pelvis (mm)", ["all", *PARTS],
        note=f"Persons {', '.join(TEST)}, trial 1, {N_PARTICLES} likelihoods a frame, {seeds} seeds; "
        f"sharpness among {', '.join(f'{s:g}' for s in SHARPNESS)} by the error on {TUNING}, the "
        f"annealed filter with a survival rate of 0.5. Manifold and joint limits: {', '.join(OTHERS)}. "
        "\"Not moving\" keeps the first pose, which is given to all.",
    )  # fmt: skip
    placed = report.table("one_placed", "The same with the place of the pelvis (mm)",
                          ["all", *PARTS])  # fmt: skip
    for action in tqdm(actions, desc="actions"):
        best = best_sharpness(folder, action)
        rows: dict[str, list[tuple[Tensor, Tensor]]] = {"not moving": []}
        for p in TEST:
            data, person = one_view(folder, p, action), prepare(folder, p, action)
            rows["not moving"].append((data.joints[:1].expand_as(data.joints), data.joints))
            for name, make in filters_of(person).items():
                for seed in range(seeds):
                    found = run(person, make, best[name], data, seed + zlib.crc32(p.encode()) % 97)
                    rows.setdefault(name, []).append((found, data.joints))
                if (action, p, name) == DRAWN:
                    states = fit_state(person.body, found)
                    draw(report, data, person.body, states, out, f"{PICTURES}/one-camera.png")
        for name, pairs in rows.items():
            label = f"{action}, {name}" + (f" ({best[name]:g})" if best.get(name, 1) > 1 else "")
            for table, without in ((centred, True), (placed, False)):
                parts = torch.tensor([part_means(f, t, without) for f, t in pairs])
                table.add(label, [float(x) for x in parts.mean(0)])


def best_sharpness(folder: Path, action: str) -> dict[str, float]:
    """Return the exponent of each filter with the smallest error on a person who is not tracked."""
    data, person = one_view(folder, TUNING, action), prepare(folder, TUNING, action)

    def error(make: Make, sharpness: float) -> float:
        return part_means(run(person, make, sharpness, data, 0), data.joints, True)[0]

    return {
        name: 1.0 if name == "APF" else min(SHARPNESS, key=lambda s, m=make: error(m, s))  # type: ignore[misc]
        for name, make in filters_of(person).items()
    }


def main(
    *,
    data: Path,
    out: Path,
    seeds: int = 3,
    only: Literal["four", "one"] | None = None,
    actions: Sequence[str] = ACTIONS,
    threads: int = 2,
) -> None:
    """Print the tables and write them as Markdown.

    Args:
        data: folder of the data sets.
        out: folder of the results.
        seeds: runs of each tracker.
        only: the tables of four cameras, or of one.
        actions: in one camera.
        threads: cores.
    """
    torch.set_num_threads(threads)
    out = check_output_folder(out)
    report = Report("Real silhouettes", {
        "seeds": seeds, "particles": N_PARTICLES, "actions": actions, "threads": threads
    })  # fmt: skip
    if only != "one":
        report_four(report, data, seeds, out)
    if only != "four":
        report_one(report, data, seeds, actions, out)
    print(report.summary())
    save_text(out / "real-silhouettes.md", report.to_markdown())


if __name__ == "__main__":
    run_command(main)
