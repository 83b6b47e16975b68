"""Learned regressors beside the mixture Kalman filter on UB-people.

Trained on persons s1 to s6 of UTD-MHAD seen from the same random views as the prior, tested on s7
and s8 with the same measurements as `python -m benchmarks.ub_people`:

- MLP, 8-256-256-24: every frame alone, on 100,000 projected poses;
- GRU, 2 x 128, causal: 1,500 steps of 32 sequences of 64 frames;
- GRU, 2 x 128, both directions: the same, and it sees the future.

Half of the training sequences are mirrored. Inputs are head and hands relative to the neck and the
neck itself, with the test's noise. Targets are the joints relative to the neck, either in the
body's own axes (`--targets body`) or in those of the camera (`--targets camera`), which need no view
to be undone; the error is taken after Procrustes, so both are scored alike. The mean over the seeds
and its spread are printed.

    python -m benchmarks.ub_people_regressors --data DIR [--report OUT/report.json]

`--report` prints the rows of a finished `python -m benchmarks.ub_people` beside them.
"""

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn
from tqdm.auto import tqdm

from benchmarks._command import run_command
from benchmarks._upper_body import score
from benchmarks.ub_people import people, still_and_moving
from torchpose.camera import project, sample_viewpoints
from torchpose.evaluation import Report
from torchpose.evaluation._person_tables import SHORT_NAMES
from torchpose.evaluation._trials import (
    CAMERA,
    MEASURED,
    Estimate,
    Trials,
    centred_on_neck,
)
from torchpose.learning import TRAINING_VIEWS
from torchpose.math import euler_to_matrix
from torchpose.skeleton import UPPER_BODY
from torchpose.skeleton._upper_body import mirror_pose

NOISE = 3.0
PIXELS = 100.0  # scale of the inputs
METRES = 0.2  # scale of the targets


def features(keypoints: Tensor, names: Sequence[str]) -> Tensor:
    """Return the other joints relative to the neck, and the neck, [..., 2 M], scaled to about 1.

    Args:
        keypoints: pixels, [..., M, 2]. names: of the M joints, a neck among them.
    """
    at = names.index("neck")
    neck = keypoints[..., at : at + 1, :]
    centre = keypoints.new_tensor([319.5, 239.5])
    rest = keypoints[..., [row for row in range(len(names)) if row != at], :] - neck
    return (torch.cat([rest, neck - centre], -2) / PIXELS).flatten(-2)


def views(n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw rotation [n, 3, 3] and translation [n, 3] of training viewpoints, float32."""
    found = sample_viewpoints(n, TRAINING_VIEWS, generator)
    return euler_to_matrix(found.angles, "zxy").float(), found.translation.float()


def examples(
    poses: Tensor, targets: str, generator: torch.Generator, names: Sequence[str] = MEASURED
) -> tuple[Tensor, Tensor]:
    """Return inputs [N, T, 2 M] and targets [N, T, 24] of sequences, each from one viewpoint.

    Args:
        poses: sequences, [N, T, 8, 3]. targets: axes of the poses that are learnt, "body" or "camera".
        generator: of views and noise. names: of the M measured joints.
    """
    flip = torch.rand(len(poses), generator=generator) < 0.5
    poses = torch.where(flip[:, None, None, None], mirror_pose(poses), poses)
    rotation, translation = views(len(poses), generator)
    rotation, translation = rotation[:, None], translation[:, None]
    uv = project(poses, CAMERA.matrix.float(), rotation, translation)[..., :2]
    keypoints = uv[..., [UPPER_BODY.index(name) for name in names], :]
    keypoints = keypoints + NOISE * torch.randn(keypoints.shape, generator=generator)
    wanted = poses if targets == "body" else poses @ rotation.mT
    return features(keypoints, names), (wanted / METRES).flatten(-2)


class Recurrent(nn.Module):
    """Two layers of 128 gated units, in one direction or both."""

    def __init__(self, n_inputs: int, both: bool) -> None:
        super().__init__()
        self.cells = nn.GRU(n_inputs, 128, 2, batch_first=True, bidirectional=both)
        self.out = nn.Linear(256 if both else 128, 24)

    def forward(self, x: Tensor, lengths: Tensor | None = None) -> Tensor:
        """Return outputs [B, T, 24]; in both directions, frames past a length are not read."""
        if lengths is None:
            return self.out(self.cells(x)[0])
        packed = nn.utils.rnn.pack_padded_sequence(x, lengths, True, enforce_sorted=False)
        hidden, _ = nn.utils.rnn.pad_packed_sequence(
            self.cells(packed)[0], True, total_length=x.shape[1]
        )
        return self.out(hidden)


def multilayer(n_inputs: int) -> nn.Module:
    return nn.Sequential(
        nn.Linear(n_inputs, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 24)
    )


def train_frames(
    poses: list[Tensor], targets: str, seed: int, quick: bool, names: Sequence[str] = MEASURED
) -> nn.Module:
    """Train the per-frame MLP on 100,000 projected poses."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    frames = torch.cat(poses)
    n, epochs = (2_000, 2) if quick else (100_000, 40)
    chosen = frames[torch.randint(len(frames), (n,), generator=generator)]
    x, y = examples(chosen[:, None], targets, generator, names)
    x, y = x[:, 0], y[:, 0]
    batches = [
        part for _ in range(epochs) for part in torch.randperm(n, generator=generator).split(512)
    ]
    model = multilayer(x.shape[-1])
    fit(model, lambda step: (x[batches[step]], y[batches[step]]), len(batches), "MLP")
    return model


def train_sequences(
    poses: list[Tensor],
    targets: str,
    seed: int,
    quick: bool,
    both: bool,
    names: Sequence[str] = MEASURED,
) -> nn.Module:
    """Train a GRU on random pieces of 64 frames of the training sequences."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    lengths = torch.tensor([len(p) for p in poses])
    stacked = torch.nn.utils.rnn.pad_sequence(poses, True)
    model = Recurrent(2 * len(names), both)

    def batch(step: int) -> tuple[Tensor, Tensor]:
        row = torch.multinomial(lengths.double(), 32, True, generator=generator)
        first = torch.rand(32, generator=generator) * (lengths[row] - 64).clamp_min(0)
        # a sequence that is too short stands still at its end
        place = torch.minimum(first.long()[:, None] + torch.arange(64), lengths[row][:, None] - 1)
        return examples(stacked[row[:, None], place], targets, generator, names)

    fit(model, batch, 10 if quick else 1_500, "GRU, both directions" if both else "GRU")
    return model


def fit(
    model: nn.Module, batch: Callable[[int], tuple[Tensor, Tensor]], n_steps: int, label: str
) -> None:
    """Fit a model by Adam with one cycle of the learning rate, to the mean distance of the joints."""
    adam = torch.optim.Adam(model.parameters(), lr=2e-3)
    cycle = torch.optim.lr_scheduler.OneCycleLR(adam, 2e-3, total_steps=n_steps)
    for step in tqdm(range(n_steps), desc=label, leave=False):
        x, y = batch(step)
        adam.zero_grad()
        distance = (model(x) - y).unflatten(-1, (8, 3)).square().sum(-1).add(1e-6).sqrt()
        distance.mean().backward()
        nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        adam.step()
        cycle.step()


def estimate(model: nn.Module, test: Trials) -> Estimate:
    """Return the poses of a test set; pixels are NaN, since the regressors give none."""
    with torch.inference_mode():
        inputs = features(test.keypoints, test.names).nan_to_num().float()
        found = model(inputs, test.lengths) if isinstance(model, Recurrent) else model(inputs)
    joints = METRES * found.unflatten(-1, (8, 3)).double()
    return Estimate(torch.full_like(test.truth2d, torch.nan), joints)


def main(
    *,
    data: Path,
    report: Path | None = None,
    seeds: int = 1,
    targets: Literal["body", "camera"] = "body",
    quick: bool = False,
) -> None:
    """Train, score and print the table.

    Args:
        data: folder kinect_utd_mhad.
        report: report.json of python -m benchmarks.ub_people.
        seeds: runs of each; ten minutes each.
        targets: axes of the poses that are learnt.
        quick: a minute, to see that it works.
    """
    train, tested = people(data, quick)
    poses = [centred_on_neck(r.upper_body().joints).float() for r in train]
    still, moving = still_and_moving(tested)
    trainers: dict[str, Callable[[int], nn.Module]] = {
        "MLP, per frame": lambda s: train_frames(poses, targets, s, quick),
        "GRU, causal": lambda s: train_sequences(poses, targets, s, quick, False),
        "GRU, both directions": lambda s: train_sequences(poses, targets, s, quick, True),
    }
    n_seeds = 1 if quick else seeds
    tables = Report("UB-people, learned regressors")
    table = tables.table(
        "errors_3d",
        f"3D error after Procrustes (cm), {n_seeds} seed(s), targets in {targets} axes",
        ["mean", "spread", "moving root", "jitter (m/s2)", *SHORT_NAMES, "training (s)"],
        digits=(2, 2, 2, 1, *[1] * 8, 0),
    )
    for name, trainer in trainers.items():
        rows = []
        for seed in range(n_seeds):
            start = time.perf_counter()
            model = trainer(seed)
            seconds = time.perf_counter() - start
            found = score(estimate(model, still), still)
            moved = score(estimate(model, moving), moving)
            rows.append([
                found.mean_error, moved.mean_error,
                float(found.jitter.mean()), *(100 * found.errors3d.flatten(0, 1).nanmean(0)).tolist(),
                seconds,
            ])  # fmt: skip
        values = torch.tensor(rows)
        spread = float(values[:, 0].std()) if len(rows) > 1 else float("nan")
        mean = values.mean(0).tolist()
        table.add(name, [mean[0], spread, *mean[1:]])
    if report is not None:
        add_finished_rows(tables, report)
    print(tables.summary())


def add_finished_rows(report: Report, path: Path) -> None:
    """Add the methods of a finished run of the protocol below the regressors."""
    tables = json.loads(path.read_text(encoding="utf-8"))["tables"]
    moved = tables["moving_root_3d"]["rows"]
    for name, row in tables["errors_3d"]["rows"].items():
        other = moved.get(name, {}).get("mean")
        joints = [row[joint] for joint in SHORT_NAMES]
        report["errors_3d"].add(
            name, [row["mean"], None, other, row["jitter (m/s2)"], *joints, None]
        )


if __name__ == "__main__":
    run_command(main)
