"""Hands in video of persons that the network was not fitted to, beside what knows no persons.

    python -m benchmarks.hand_network --data DIR --out FOLDER [--table FILE]
    python -m benchmarks.hand_network --data DIR --out FOLDER --fit FILE.safetensors

The labels are MediaPipe's, as good as these are: a hand is seven tenths of the way from wrist to index
finger, is seen where its visibility is above 0.6 and it is in the image, and is not to be seen where that is
below 0.15 or the hand is below the image. Four fits leave three persons out each; six rendered performers,
whose truth is exact, are in every fit. The second line fits the network that comes with torchpose, to
everybody. FOLDER keeps rendered videos and fits: started again, the command goes on where it stopped.

Columns: seen hands that are measured within a quarter of the shoulders' width; hands that are measured
although they are not to be seen. The first 15 frames of a clip are not scored.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch

from benchmarks._table_file import table_file
from benchmarks.hand_network.clips import (
    BURN_IN,
    FOLDS,
    PEOPLE,
    SIGNERS,
    Clip,
    Windows,
    measure,
    read_clips,
    render_clips,
    windows_of,
)
from benchmarks.hand_network.training import STEPS, fit
from torchpose import load_prior
from torchpose._core.files import check_output_folder
from torchpose.evaluation import Report
from torchpose.measure import HandTracker
from torchpose.measure._hand_network import HandNetwork, HandNetworkInfo
from torchpose.measure._hand_prior import HandPrior
from torchpose.video import open_video

_QUICK_STEPS = 3


class Score(NamedTuple):
    """Counts of hands: right ones of those that are seen, measured ones of those that are not to be seen."""

    right: int
    seen: int
    invented: int
    gone: int


def score(clip: Clip, network: HandNetwork | None) -> Score:
    """Return the counts of a clip, by a tracker with a network, or without (None)."""
    prior = HandPrior.from_prior(load_prior("kinect-upper-body"))
    with open_video(clip.path) as video:
        tracker = HandTracker(prior, fps=video.fps, network=network)
    right = invented = 0
    labels = clip.labels
    for t, _, hands, _ in measure(clip, tracker):
        if t <= BURN_IN:
            continue
        near = (hands.points - labels.centres[t]).norm(dim=-1) < labels.width / 4
        right += int((near & hands.seen & (labels.seen[t] == 1)).sum())
        invented += int((hands.seen & (labels.seen[t] == 0)).sum())
    known = labels.seen[BURN_IN + 1 :]
    return Score(right, int((known == 1).sum()), invented, int((known == 0).sum()))


@cache
def cached_windows(clip: Clip) -> Windows:
    """Return the windows of a clip, which are measured once and only if a fit needs them."""
    return windows_of(clip)


def fitted(clips: Sequence[Clip], path: Path, info: HandNetworkInfo, steps: int) -> HandNetwork:
    """Return the network of a file, or fit it and write the file."""
    if not path.is_file():
        fit([(clip.person, cached_windows(clip)) for clip in clips], info, steps).save(path)
    return HandNetwork.load(path)


def facts(clips: Sequence[Clip], name: str, command: str) -> HandNetworkInfo:
    """Return what a network says about its fit."""
    return HandNetworkInfo(
        name=name,
        clips=tuple(clip.name for clip in clips),
        persons=tuple(sorted({clip.person for clip in clips})),
        licence="MIT; see the card for the clips",
        command=command,
    )


def add_table(report: Report, scores: dict[str, tuple[Score, Score]]) -> None:
    """Add the scores of all clips, without and with a network that knows nobody in them."""
    columns = ("right, grid (%)", "right, learnt (%)", "invented, grid (%)", "invented, learnt (%)")
    table = report.table("hands", "Hands of persons left out", columns, digits=(0, 0, 0, 0))

    def share(part: int, whole: int) -> float:
        return 100 * part / whole if whole else float("nan")

    rows = {
        name: [share(s.right, s.seen) for s in pair] + [share(s.invented, s.gone) for s in pair]
        for name, pair in scores.items()
    }
    for name, row in rows.items():
        table.add(name, row)
    for title, names in (("mean of strangers", PEOPLE), ("mean of signers", SIGNERS)):
        values = torch.tensor([rows[name] for name in names if name in rows])
        if len(values):
            table.add(title, values.nanmean(0))


def main() -> None:
    """Print the table, or fit the network that comes with torchpose."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder with the clips")
    parser.add_argument("--out", type=Path, required=True, help="folder for what is kept")
    parser.add_argument("--fit", type=Path, help="file for a network that knows everybody")
    parser.add_argument("--table", type=table_file, help="file for the table, or a folder")
    parser.add_argument("--threads", type=int, default=2, help="cores")
    parser.add_argument("--quick", action="store_true", help="two clips and no fit worth its name")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    out = check_output_folder(args.out)
    clips = read_clips(args.data)
    rendered = render_clips(out)
    steps = STEPS
    if args.quick:
        chosen = ("akstheme_gesture", "milk")
        clips, rendered, steps = [c for c in clips if c.name in chosen], rendered[:1], _QUICK_STEPS
    labelled = [*clips, *rendered]
    if args.fit is not None:
        command = (
            "python -m benchmarks.hand_network --data DIR --out FOLDER --fit hands.safetensors"
        )
        windows = [(clip.person, cached_windows(clip)) for clip in labelled]
        fit(windows, facts(labelled, "hands", command), steps).save(args.fit)
        return
    scores = {}
    for number, persons in enumerate(FOLDS):
        left_out = [clip for clip in clips if clip.person in persons]
        if not left_out:
            continue
        known = [clip for clip in labelled if clip.person not in persons]
        info = facts(known, f"without {', '.join(persons)}", "")
        network = fitted(known, out / f"fold-{number}.safetensors", info, steps)
        for clip in left_out:
            scores[clip.name] = score(clip, None), score(clip, network)
    report = Report("Hands of persons left out")
    add_table(report, scores)
    text = report["hands"].to_markdown()
    print(text)
    if args.table is not None:
        args.table.write_text(text + "\n")


if __name__ == "__main__":
    main()
