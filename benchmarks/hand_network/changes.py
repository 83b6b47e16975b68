"""Change labelled windows at random: place, size, side, colours; hands, bare skin and borders elsewhere."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate

from benchmarks.hand_network.clips import Windows
from torchpose.measure._body_window import CELL, CELLS, EVIDENCE, cell_centres

__all__ = ["bare_skin", "bordered", "exchanged", "lit", "mirrored", "moved"]

_SIZES, _SHIFT = (0.85, 1.25), (0.8, 0.5)  # of windows, and how far they are moved, in B
_CONTRAST, _TINT, _GRAIN, _FAINT = 0.25, 0.3, 0.06, 0.2
_GAIN, _CAST, _SLOPE, _PALE = 0.2, 0.3, 0.15, 0.15  # deviations of light; how often it is pale
_PALEST = 0.3
_EXCHANGED, _BARE, _BORDERED = 0.5, 0.5, 0.3  # how often windows are changed so
_DISC = (0.6, 1.1)  # radius of what is exchanged, in B
_RIM = 3.0  # cells about a border or an edge within which a hand is neither seen nor gone
_BELOW, _BESIDE = (0.6, 5.0), (1.2, 4.2)  # from the anchor to a new border of the image, in B
_UNKNOWN_SKIN = 0.15
_CLEAR = (0.55, 0.15)  # B about hands and face that stay as they are, and over how far that fades
_SKIN = (0.6, 0.35, 0.35)  # deviation of the colour of bare skin from the face's
_LEGS, _NECKS = 0.45, 0.3  # of bare skin; the rest lies anywhere


def moved(batch: Windows) -> Windows:
    """Return windows moved and resized at random, with their labels."""
    lab, maps, faces, places, seen = batch
    count = len(lab)
    size = _between(_SIZES, count)
    shift = (2 * torch.rand(count, 2) - 1) * torch.tensor(_SHIFT)
    lab = grid_sample(lab, _grid(2, faces, size, shift), padding_mode="border", align_corners=False)
    maps = grid_sample(maps, _grid(1, faces, size, shift), align_corners=False)
    first = cell_centres()[0, 0]
    at = first + places * CELL - faces[:, None, :2]
    at = (at + shift[:, None]) * size[:, None, None] + faces[:, None, :2]
    faces = torch.cat([faces[:, :2] + shift * size[:, None], faces[:, 2:] * size[:, None]], 1)
    return Windows(lab, maps, faces, (at - first) / CELL, seen)


def mirrored(batch: Windows, which: Bool[Tensor, " N"]) -> Windows:
    """Return windows of which some are mirrored: left hands are then right ones."""
    images = [torch.where(which[:, None, None, None], x.flip(-1), x) for x in batch[:2]]
    faces = torch.where(
        which[:, None], batch.faces * batch.faces.new_tensor([-1.0, 1.0, 1.0]), batch.faces
    )
    other = _other_side(batch.places) * batch.places.new_tensor([-1.0, 1.0])
    other = other + batch.places.new_tensor([CELLS[1] - 1.0, 0.0])
    places = torch.where(which[:, None, None], other, batch.places)
    seen = torch.where(which[:, None], _other_side(batch.seen), batch.seen)
    return Windows(images[0], images[1], faces, places, seen)


def _other_side(values: Tensor) -> Tensor:
    """Return values [N, J, ...] of left and right joints in turn, with left and right swapped."""
    return values.unflatten(1, (-1, 2)).flip(2).flatten(1, 2)


def exchanged(batch: Windows) -> Windows:
    """Return windows with discs out of each other: with hands where there were none, or the reverse.

    A disc lies about a hand that the other window shows and this one does not, or about one that this
    window shows. So no person's hands are always there, or never.
    """
    count = len(batch.lab)
    order, rows = torch.randperm(count), torch.arange(count)
    other = Windows(*(values[order] for values in batch))
    hand = torch.randint(2, (count,))
    theirs, ours = other.seen[rows, hand] == 1, batch.seen[rows, hand] == 1
    at = torch.where(ours[:, None], batch.places[rows, hand], other.places[rows, hand])
    known = (batch.maps[:, 3] * other.maps[:, 3])[:, None]
    which = (theirs | ours) & (torch.rand(count) < _EXCHANGED) & _inside(known, at)
    radius = _between(_DISC, count) * batch.faces[:, 2] / CELL
    disc = known * _disc(at, radius, 1)[:, None] * which[:, None, None, None]
    fine = _twice(known) * _disc(at, radius, EVIDENCE)[:, None] * which[:, None, None, None]
    maps = torch.cat([batch.maps[:, :3].lerp(other.maps[:, :3], disc), batch.maps[:, 3:]], 1)
    places, seen = _exchanged_labels(batch, other, at, torch.where(which, radius, -_RIM))
    return Windows(batch.lab.lerp(other.lab, fine), maps, batch.faces, places, seen)


def _exchanged_labels(
    batch: Windows, other: Windows, at: Float[Tensor, "N 2"], radius: Float[Tensor, " N"]
) -> tuple[Tensor, Tensor]:
    """Return places and labels where discs of one window are replaced by those of the other."""
    away = (batch.places - at[:, None]).norm(dim=-1) - radius[:, None]
    under = (other.places - at[:, None]).norm(dim=-1) < radius[:, None]
    covered, brought = (batch.seen == 1) & (away < 0), under & (other.seen == 1)
    alone = covered | (batch.seen == 0)  # else there would be two of it
    seen = torch.where(covered, 0, batch.seen)
    seen = torch.where((away.abs() < _RIM) & (batch.seen == 1), -1, seen)
    seen = torch.where(under & (other.seen == -1), -1, seen)
    seen = torch.where(brought, torch.where(alone, 1, -1), seen)
    return torch.where((brought & alone)[..., None], other.places, batch.places), seen


def bare_skin(batch: Windows) -> Windows:
    """Return windows of which some show limbs, necks and spots of bare skin, no hands, that do not move."""
    which = torch.rand(len(batch.lab)) < _BARE
    lab, maps = batch.lab.clone(), batch.maps.clone()
    if bool(which.any()):
        lab[which], maps[which] = _with_skin(Windows(*(values[which] for values in batch)))
    return batch._replace(lab=lab, maps=maps)


def _with_skin(batch: Windows) -> tuple[Tensor, Tensor]:
    """Return colours and maps of windows with bare skin, away from hands and faces."""
    count = len(batch.lab)
    shapes, across = _capsules(*_limbs(batch.faces))
    places = torch.cat([batch.places * CELL + cell_centres()[0, 0], batch.faces[:, None, :2]], 1)
    known = torch.cat([batch.seen != 0, torch.ones(count, 1, dtype=torch.bool)], 1)
    shapes = shapes * _clear(places, known, batch.faces)[:, None] * _twice(batch.maps[:, 3:])
    colour = torch.randn(count, 3, 1, 1) * torch.tensor(_SKIN)[:, None, None]  # from the face's
    dark = torch.tensor([0.5, 0.0, 0.0])[:, None, None]  # towards the edges
    lab, maps = batch.lab, batch.maps.clone()
    skin = _between((0.3, 1.0), count)[:, None, None]
    for shape, edge in zip(shapes.unbind(1), across.unbind(1), strict=True):
        lab = lab.lerp(colour - dark * edge[:, None].square(), shape[:, None])
        small = avg_pool2d(shape, EVIDENCE)
        maps[:, 0] = maps[:, 0].lerp(skin.expand_as(small), small)
        maps[:, 1:3] *= 1 - small[:, None]
    return lab, maps


def _limbs(faces: Float[Tensor, "N 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Return two ends [N, 2, 2] and radii [N, 2, 2] of two limbs: legs, a neck, or anything."""
    count = len(faces)
    wide, spread = _between((0.4, 1.3), count), _between((-0.3, 0.6), count)
    high, long = _between((3.8, 5.2), count), _between((1.0, 3.5), count)
    sides = torch.tensor([-1.0, 1.0])
    legs = [
        torch.stack(torch.broadcast_tensors(sides * x[:, None], y[:, None]), -1)
        for x, y in ((wide, high), (wide + spread, high + long))
    ]
    neck = [
        torch.stack([_between((-0.2, 0.2), count), y], -1)[:, None].expand(-1, 2, -1)
        for y in (_between((0.7, 1.1), count), _between((1.1, 2.0), count))
    ]
    first = torch.stack([_between((-4.5, 4.5), (count, 2)), _between((-2.0, 5.5), (count, 2))], -1)
    turn = _between((0.0, 6.3), (count, 2))
    step = torch.stack([turn.cos(), turn.sin()], -1) * _between((0.0, 3.0), (count, 2))[..., None]
    kind = torch.rand(count)[:, None, None]
    start, end = (
        torch.where(kind < _LEGS, leg, torch.where(kind < _LEGS + _NECKS, one, anywhere))
        for leg, one, anywhere in zip(legs, neck, (first, first + step), strict=True)
    )
    at, size = faces[:, None, :2], faces[:, 2, None, None]
    return at + size * start, at + size * end, size * _between((0.15, 0.55), (count, 2, 2))


def _capsules(
    start: Float[Tensor, "N K 2"], end: Float[Tensor, "N K 2"], radii: Float[Tensor, "N K 2"]
) -> tuple[Tensor, Tensor]:
    """Return the share of each pixel that is within a limb, and how far it is from its middle, of one."""
    points = cell_centres(EVIDENCE)
    start, along = start[:, :, None, None], (end - start)[:, :, None, None]
    away = points - start
    part = ((away * along).sum(-1) / along.square().sum(-1).clamp_min(1e-6)).clamp(0, 1)
    radius = radii[..., :1, None].lerp(radii[..., 1:, None], part)
    distance = (away - part[..., None] * along).norm(dim=-1)
    return ((radius - distance) / CELL + 0.5).clamp(0, 1), (distance / radius).clamp(0, 1)


def _clear(
    places: Float[Tensor, "N K 2"], which: Bool[Tensor, "N K"], faces: Float[Tensor, "N 3"]
) -> Tensor:
    """Return zero about places, in B from the anchors, and one away from them."""
    away = (cell_centres(EVIDENCE) - places[:, :, None, None]).norm(dim=-1)
    away = (away / faces[:, 2, None, None, None] - _CLEAR[0]) / _CLEAR[1]
    return torch.where(which[..., None, None], away, 1.0).clamp(0, 1).amin(1)


def bordered(batch: Windows) -> Windows:
    """Return windows of which some have a border of the image nearer: hands beyond it are gone."""
    count = len(batch.lab)
    bottom, left, right = (
        torch.where(torch.rand(count) < share, _between(reach, count), torch.inf)
        for share, reach in (
            (_BORDERED, _BELOW),
            (_BORDERED / 4, _BESIDE),
            (_BORDERED / 4, _BESIDE),
        )
    )
    x, y = cell_centres().unbind(-1)
    within = _beyond(x, y, *(side[:, None, None] for side in (bottom, left, right))) < 0
    maps = batch.maps * within[:, None]
    maps[:, 0] += _UNKNOWN_SKIN * ~within
    places = batch.places * CELL + cell_centres()[0, 0]
    beyond = _beyond(*places.unbind(-1), *(side[:, None] for side in (bottom, left, right))) / CELL
    at_edge = (beyond.abs() < _RIM) & (batch.seen == 1)
    gone = (beyond >= _RIM) & (batch.seen == 1)
    seen = torch.where(gone, 0, torch.where(at_edge, -1, batch.seen))
    return batch._replace(maps=maps, seen=seen)


def _beyond(x: Tensor, y: Tensor, bottom: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """Return how far places are beyond the borders, in B; negative within."""
    return torch.maximum(y - bottom, torch.maximum(-left - x, x - right))


def lit(batch: Windows) -> Windows:
    """Return windows in other light: gain, cast, light from a side, pale colours, noise; fainter maps."""
    count = len(batch.lab)
    one = torch.randn(count, 3, 1, 1)
    lab = batch.lab * (1 + _CONTRAST * one) + _TINT * torch.randn(count, 3, 1, 1)
    lab = lab * (1 + _GAIN * torch.randn(count, 1, 1, 1)) + _CAST * torch.randn(count, 3, 1, 1)
    height, width = lab.shape[2:]
    x, y = torch.linspace(-1, 1, width), torch.linspace(-1, 1, height)[:, None]
    slope = _SLOPE * torch.randn(2, count, 1, 1)
    pale = torch.where(torch.rand(count, 1, 1, 1) < _PALE, _PALEST, 1.0)
    lab = torch.cat([lab[:, :1] + (slope[0] * x + slope[1] * y)[:, None], lab[:, 1:] * pale], 1)
    lab = lab + _GRAIN * torch.randn_like(lab)
    faint = 1 + _FAINT * torch.randn(count, 3, 1, 1)
    maps = torch.cat([(batch.maps[:, :3] * faint).clamp(0, 1), batch.maps[:, 3:]], 1)
    return batch._replace(lab=lab, maps=maps)


def _between(limits: tuple[float, float], size: int | tuple[int, ...]) -> Tensor:
    """Return random numbers between limits."""
    low, high = limits
    return low + (high - low) * torch.rand(size)


def _twice(maps: Float[Tensor, "N C h w"]) -> Tensor:
    """Return maps of cells at the pixels of evidence."""
    return interpolate(maps, scale_factor=float(EVIDENCE))


def _inside(known: Float[Tensor, "N 1 h w"], at: Float[Tensor, "N 2"]) -> Tensor:
    """Return whether cells are in the window, and in the image of both windows."""
    high = torch.tensor([CELLS[1], CELLS[0]]) - 1
    column, row = at.long().minimum(high).clamp_min(0).unbind(-1)
    within = ((at >= 0) & (at <= high)).all(-1)
    return within & (known[torch.arange(len(at)), 0, row, column] > 0.5)


def _disc(at: Float[Tensor, "N 2"], radius: Float[Tensor, " N"], per_cell: int) -> Tensor:
    """Return soft discs about cells [N, h, w]; radii in cells."""
    points = (cell_centres(per_cell) - cell_centres()[0, 0]) / CELL
    away = (points - at[:, None, None]).norm(dim=-1)
    return ((radius[:, None, None] - away) / 1.5 + 0.5).clamp(0, 1)


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
