"""Fit a `HandNetwork` to labelled windows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample
from tqdm.auto import tqdm

from benchmarks.hand_network.clips import Windows
from torchpose.measure._body_window import CELL, CELLS, cell_centres
from torchpose.measure._hand_network import COARSE, HandNetwork, HandNetworkInfo, relative_colours

STEPS, BATCH, _RATE, _DECAY = 900, 16, 3e-3, 1e-2
_SIZES, _SHIFT = (0.85, 1.25), (0.8, 0.5)  # of windows, and how far they are moved, in B
_BLUR = 0.9  # coarse cells: of a label
_CONTRAST, _TINT, _GRAIN, _FAINT = 0.25, 0.3, 0.06, 0.2

__all__ = ["STEPS", "fit"]


def fit(
    clips: Sequence[tuple[str, Windows]],
    info: HandNetworkInfo | None = None,
    steps: int = STEPS,
    seed: int = 0,
    progress: bool = True,
) -> HandNetwork:
    """Return a network fitted to windows of persons, each person as often as any other.

    Args:
        clips: person and windows of each. info: of the network. steps: of AdamW, 16 windows each.
        seed: of weights, order and changes. progress: whether to show a bar.
    """
    torch.manual_seed(seed)
    network = HandNetwork(info)
    by_person: dict[str, list[Windows]] = {}
    for person, windows in clips:
        by_person.setdefault(person, []).append(windows)
    persons = list(by_person.values())
    optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, total_steps=steps)
    for _ in tqdm(range(steps), disable=not progress, desc="fitting"):
        batch = _changed(_drawn(persons))
        maps = avg_pool2d(batch.maps, 2)
        loss = _loss(network(batch.lab, maps, batch.faces), batch)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return network.eval().requires_grad_(False)


def _drawn(persons: Sequence[Sequence[Windows]]) -> Windows:
    """Return windows of random persons, clips and frames."""
    rows = []
    for _ in range(BATCH):
        clips = persons[int(torch.randint(len(persons), ()))]
        windows = clips[int(torch.randint(len(clips), ()))]
        row = int(torch.randint(len(windows.lab), ()))
        rows.append([values[row] for values in windows])
    lab, maps, faces, places, seen = (torch.stack(column) for column in zip(*rows, strict=True))
    return Windows(relative_colours(lab, faces), maps.float(), faces, places, seen)


def _changed(batch: Windows) -> Windows:
    """Return windows moved, resized, mirrored, and of other colours, at random."""
    lab, maps, faces, places, seen = batch
    count = len(lab)
    low, high = _SIZES
    size = low + (high - low) * torch.rand(count)
    shift = (2 * torch.rand(count, 2) - 1) * torch.tensor(_SHIFT)
    lab = grid_sample(lab, _grid(2, faces, size, shift), padding_mode="border", align_corners=False)
    maps = grid_sample(maps, _grid(1, faces, size, shift), align_corners=False)
    first = cell_centres()[0, 0]
    at = first + places * CELL - faces[:, None, :2]
    at = (at + shift[:, None]) * size[:, None, None] + faces[:, None, :2]
    places = (at - first) / CELL
    faces = torch.cat([faces[:, :2] + shift * size[:, None], faces[:, 2:] * size[:, None]], 1)
    mirrored = torch.rand(count) < 0.5
    batch = _mirrored(Windows(lab, maps, faces, places, seen), mirrored)
    one = torch.randn(count, 3, 1, 1)
    lab = batch.lab * (1 + _CONTRAST * one) + _TINT * torch.randn(count, 3, 1, 1)
    lab = lab + _GRAIN * torch.randn_like(lab)
    faint = 1 + _FAINT * torch.randn(count, 3, 1, 1)
    maps = torch.cat([(batch.maps[:, :3] * faint).clamp(0, 1), batch.maps[:, 3:]], 1)
    return batch._replace(lab=lab, maps=maps)


def _grid(
    per_cell: int,
    faces: Float[Tensor, "N 3"],
    size: Float[Tensor, " N"],
    shift: Float[Tensor, "N 2"],
) -> Tensor:
    """Return where each pixel of the changed window was in the window, as `grid_sample` takes it."""
    places = cell_centres(per_cell)
    middle = (places[0, 0] + places[-1, -1]) / 2
    half = places.new_tensor([CELLS[1], CELLS[0]]) * CELL / 2
    at = (places - faces[:, None, None, :2]) / size[:, None, None, None]
    at = at + (faces[:, :2] - shift)[:, None, None]
    return (at - middle) / half


def _mirrored(batch: Windows, which: Tensor) -> Windows:
    """Return windows of which some are mirrored: left hands are then right ones."""
    images = [torch.where(which[:, None, None, None], x.flip(-1), x) for x in batch[:2]]
    faces = torch.where(
        which[:, None], batch.faces * batch.faces.new_tensor([-1.0, 1.0, 1.0]), batch.faces
    )
    other = batch.places.flip(1) * batch.places.new_tensor([-1.0, 1.0])
    other = other + batch.places.new_tensor([CELLS[1] - 1.0, 0.0])
    places = torch.where(which[:, None, None], other, batch.places)
    seen = torch.where(which[:, None], batch.seen.flip(1), batch.seen)
    return Windows(images[0], images[1], faces, places, seen)


def _loss(logits: Float[Tensor, "N 2 cells"], batch: Windows) -> Tensor:
    """Return the mean cross-entropy of hands that are seen in the window, or are not to be seen."""
    at = batch.places / 2 - 0.25  # coarse cells
    rows, columns = (torch.arange(n, dtype=at.dtype) for n in COARSE)
    across = -0.5 * ((columns - at[..., :1]) / _BLUR).square()
    down = -0.5 * ((rows - at[..., 1:]) / _BLUR).square()
    target = (across[..., None, :] + down[..., None]).exp().flatten(2)
    target = target / target.sum(-1, keepdim=True).clamp_min(1e-9)
    high = at.new_tensor([COARSE[1], COARSE[0]])
    inside = ((at > -1) & (at < high)).all(-1)
    logs = torch.log_softmax(logits, -1)
    here, gone = -(target * logs[..., :-1]).sum(-1), -logs[..., -1]
    seen, absent = (batch.seen == 1) & inside, batch.seen == 0
    return (here[seen].sum() + gone[absent].sum()) / (seen.sum() + absent.sum()).clamp_min(1)
