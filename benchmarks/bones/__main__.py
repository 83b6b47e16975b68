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
other methods have the prior that comes with torchpose, which was fitted to none of these persons; for
UTD-MHAD one that is fitted to s1 to s6 as in UB-people.

    python -m benchmarks.bones --data DIR [--out FILE] [--pictures FOLDER]
    python -m benchmarks.bones --data DIR --fit FILE.safetensors

The second line fits the prior over arms that comes with torchpose, to all sets.

Lifts put elbow and wrist on the rays of their pixels at the depth that the length of the bone leaves,
all forward; with the person's own lengths they know what a tracker has to find out.
"""

from __future__ import annotations

from pathlib import Path

import torch

from benchmarks._command import run_command
from benchmarks._table_file import TableFile, print_tables
from benchmarks.bones.fits import fit_shipped
from benchmarks.bones.tables import add_group, draw, groups, priors_of
from torchpose._core.files import check_output_folder
from torchpose.evaluation import Report

_NAMES = ("mhad", "openpose", "webcam", "utd-mhad")  # of groups, for pictures


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
            draw(group, *priors, pictures, name, n_frames=1 if quick else 8)
        add_group(report, group, *priors)
    print_tables(report, out)


if __name__ == "__main__":
    run_command(main)
