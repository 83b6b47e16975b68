"""Direction of first poses found in silhouettes, by one frame and by half a second.

Walks of four persons (`mocap_cmu_walk`) are rendered as in the protocol Silhouette; where the data has
them, the four views of a balancing man (`multicam_pose2sim`) are searched from several of their frames.

    python -m benchmarks.first_pose --data DIR [--seeds 3] [--cameras 3] [--manifold]
"""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks._command import run_command
from benchmarks.bodies.clips import split_clips
from benchmarks.bodies.views import Conditions
from benchmarks.real_silhouettes import HEIGHT, four_views
from benchmarks.silhouette.filters import prepare
from benchmarks.silhouette.protocol import FPS, WALKERS
from torchpose.body import BODY_15, Body, fit_state
from torchpose.camera import CameraRig
from torchpose.io import read_mocap
from torchpose.metrics import joint_errors
from torchpose.priors import BackConstrainedGPLVM
from torchpose.whole_body import find_first_pose, find_pose

LOOK_AHEAD = 30  # frames at 60 Hz
TRIALS, CLIP = 3, 45  # of each person, and frames that the cameras stand around
STARTS = range(0, 70, 15)  # frames of the four views to start from


class Start(NamedTuple):
    """What a search is given, and the joints [15, 3] of the first frame."""

    body: Body
    silhouettes: Tensor
    rig: CameraRig
    manifold: BackConstrainedGPLVM | None
    up: Tensor | None
    joints: Tensor


def walks(folder: Path, cameras: int, with_manifold: bool) -> Iterator[Start]:
    """Yield the first frames of three trials of each person."""
    clips = read_mocap(folder, FPS)
    for split in split_clips(clips, WALKERS, WALKERS, TRIALS):
        tracked = prepare(split, Conditions(cameras_used=cameras), CLIP, LOOK_AHEAD)
        manifold = tracked.manifold if with_manifold else None
        for view in tracked.tests:
            yield Start(
                tracked.body, view.silhouettes[:LOOK_AHEAD], view.rig, manifold, view.clip.up,
                view.clip.joints[0],
            )  # fmt: skip


def balancing(folder: Path) -> Iterator[Start]:
    """Yield several frames of the four views, with a body of average proportions."""
    data, body = four_views(folder), Body.of_height(BODY_15, HEIGHT)
    for t in STARTS:
        frames = data.silhouettes[t : t + LOOK_AHEAD]
        yield Start(body, frames, data.rig, None, None, data.joints[t])


def one_frame(start: Start, generator: torch.Generator) -> Tensor:
    """Return the pose that fits the first frame best."""
    return find_pose(
        start.body, start.silhouettes[0], start.rig, start.manifold, generator, up=start.up
    )


def half_a_second(start: Start, generator: torch.Generator) -> Tensor:
    """Return the first pose whose track over half a second fits best."""
    return find_first_pose(
        start.body, start.silhouettes, start.rig, start.manifold, generator, fps=FPS, up=start.up
    ).state


def row(
    name: str, starts: Sequence[Start], seeds: int, find: Callable[[Start, torch.Generator], Tensor]
) -> str:
    """Return a row: how many found poses face the right way, mean and largest error (mm)."""
    right, errors = 0, []
    for start in tqdm(starts, desc=name, disable=None):
        truth = fit_state(start.body, start.joints[None])[0]
        for seed in range(seeds):
            found = find(start, torch.Generator().manual_seed(seed))
            ahead = start.body.part_rotations(torch.stack([found, truth]))[:, 0, :, 2]
            right += int(float(ahead[0] @ ahead[1]) > 0)
            gap = joint_errors(start.body.joints(found), start.joints)
            errors.append(1000 * float(gap.nanmean()))
    count = len(errors)
    return f"| {name} | {right} of {count} | {sum(errors) / count:.0f} | {max(errors):.0f} |"


def main(*, data: Path, seeds: int = 3, cameras: int = 3, manifold: bool = False) -> None:
    """Print the table.

    Args:
        data: folder of the data sets.
        seeds: runs for each start.
        cameras: around each walk.
        manifold: poses of the manifold of walks in place of every pose.
    """
    groups = {"walks": list(walks(data / "mocap_cmu_walk", cameras, manifold))}
    if (data / "multicam_pose2sim").is_dir() and not manifold:
        groups["balancing man"] = list(balancing(data))
    print("| | faces the right way | error (mm) | largest (mm) |\n| --- | ---: | ---: | ---: |")
    for name, starts in groups.items():
        print(row(f"{name}, one frame", starts, seeds, one_frame))
        print(row(f"{name}, half a second", starts, seeds, half_a_second))


if __name__ == "__main__":
    run_command(main)
