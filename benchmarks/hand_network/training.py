"""Fit a `HandNetwork` to labelled windows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d
from tqdm.auto import tqdm

from benchmarks.hand_network.changes import bare_skin, bordered, exchanged, lit, mirrored, moved
from benchmarks.hand_network.clips import Windows
from torchpose.measure._hand_network import COARSE, HandNetwork, HandNetworkInfo, relative_colours

STEPS, BATCH, _RATE, _DECAY = 1500, 16, 3e-3, 1e-2
_BLUR = 0.9  # coarse cells: of a label
_PARTS = (slice(0, 2), 1.0), (slice(2, 4), 0.7)  # hands and elbows, and how much they count

__all__ = ["STEPS", "fit"]


def fit(
    clips: Sequence[tuple[str, Windows]],
    info: HandNetworkInfo | None = None,
    steps: int = STEPS,
    seed: int = 0,
    progress: bool = True,
) -> HandNetwork:
    """Return a network fitted to windows of persons, each person equally often.

    Hands and elbows are fitted together, so that the features serve both.

    Args:
        clips: person and windows of each. info: facts about the fit. steps: of AdamW, 16 windows each.
        seed: of weights, order and changes. progress: whether to show a bar.
    """
    torch.manual_seed(seed)
    network = HandNetwork(info).to(memory_format=torch.channels_last)
    by_person: dict[str, list[Windows]] = {}
    for person, windows in clips:
        by_person.setdefault(person, []).append(windows)
    persons = list(by_person.values())
    optimiser = torch.optim.AdamW(network.parameters(), lr=_RATE, weight_decay=_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, total_steps=steps)
    for _ in tqdm(range(steps), disable=not progress, desc="fitting"):
        batch = _changed(_drawn(persons))
        with torch.autocast("cpu", torch.bfloat16):
            logits = network(batch.lab, avg_pool2d(batch.maps, 2), batch.faces)
        loss = sum(
            weight * _loss(logits[:, part].float(), batch.places[:, part], batch.seen[:, part])
            for part, weight in _PARTS
        )
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
    """Return windows with random changes of everything that strangers do not share with known persons."""
    batch = mirrored(moved(batch), torch.rand(len(batch.lab)) < 0.5)
    return lit(bordered(bare_skin(exchanged(batch))))


def _loss(
    logits: Float[Tensor, "N 2 cells"], places: Float[Tensor, "N 2 2"], labels: Tensor
) -> Tensor:
    """Return the mean cross-entropy of joints that are visible in the window, or not visible."""
    at = places / 2 - 0.25  # coarse cells
    rows, columns = (torch.arange(n, dtype=at.dtype) for n in COARSE)
    across = -0.5 * ((columns - at[..., :1]) / _BLUR).square()
    down = -0.5 * ((rows - at[..., 1:]) / _BLUR).square()
    target = (across[..., None, :] + down[..., None]).exp().flatten(2)
    target = target / target.sum(-1, keepdim=True).clamp_min(1e-9)
    high = at.new_tensor([COARSE[1], COARSE[0]])
    inside = ((at > -1) & (at < high)).all(-1)
    logs = torch.log_softmax(logits, -1)
    here, gone = -(target * logs[..., :-1]).sum(-1), -logs[..., -1]
    seen, absent = (labels == 1) & inside, labels == 0
    return (here[seen].sum() + gone[absent].sum()) / (seen.sum() + absent.sum()).clamp_min(1)
