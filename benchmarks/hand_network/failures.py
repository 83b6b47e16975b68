"""Drawings of frames in which a hand is wrong, by kind: lines in place of recordings of persons."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchmarks._sheets import sheet
from benchmarks.hand_network.clips import BURN_IN, Labels

_PER_KIND = 8
_WIDTH, _HEIGHT = 280, 240  # pixels of a drawing
_COLOURS = ((0, 140, 0), (210, 0, 0))  # of left and right
_INK, _PAPER = (90, 90, 90), 255


class Found(NamedTuple):
    """Holds what a tracker measured in a clip of T frames.

    Attributes:
        points: hands, then elbows, pixels [T, 2, 2, 2]. measured: whether each is measured [T, 2, 2].
        faces: centre and size, NaN where the person is not found [T, 3]. size: of the image, pixels.
    """

    points: Tensor
    measured: Tensor
    faces: Tensor
    size: tuple[int, int]


def failures(found: Found, labels: Labels) -> Iterator[tuple[int, str]]:
    """Yield the frames in which a hand is wrong, and the kind of failure."""
    near = labels.width / 4
    for t in range(BURN_IN + 1, len(found.faces)):
        if bool(found.faces[t].isnan().any()):
            continue
        for hand in (0, 1):
            kind = _kind(found, labels, t, hand, near)
            if kind is not None:
                yield t, kind


def _kind(found: Found, labels: Labels, t: int, hand: int, near: float) -> str | None:
    """Return how a hand is wrong; None if it is right, or has no label."""
    seen, truth = int(labels.seen[t, hand]), labels.centres[t, :2]
    point, face = found.points[t, 0, hand], found.faces[t]
    if not bool(found.measured[t, 0, hand]):
        return "missed" if seen == 1 else None
    if seen == 0:
        return "invented"
    if seen < 0 or float((point - truth[hand]).norm()) < near:
        return None
    if int(labels.seen[t, 1 - hand]) == 1 and float((point - truth[1 - hand]).norm()) < near:
        return "at the other hand"
    on_face = float((point - face[:2]).norm()) <= 0.8 * float(face[2])
    return "on the face" if on_face else "elsewhere"


def draw_failures(
    folder: Path, found: Mapping[str, tuple[Found, Labels]]
) -> Iterator[tuple[str, int, Path]]:
    """Draw a sheet for each kind of failure, of frames that are spread over all clips.

    Args:
        folder: for the sheets. found: what was measured in each clip, and its labels.

    Yields:
        Kind, number of hands, and file.
    """
    import cv2

    kinds: dict[str, dict[str, list[int]]] = {}
    for clip, (measured, labels) in found.items():
        for t, kind in failures(measured, labels):
            kinds.setdefault(kind, {}).setdefault(clip, []).append(t)
    folder.mkdir(parents=True, exist_ok=True)
    for kind, clips in sorted(kinds.items()):
        views = [_drawing(clip, t, *found[clip]) for clip, t in _spread(clips)]
        path = folder / f"{kind.replace(' ', '-')}.png"
        cv2.imwrite(str(path), cv2.cvtColor(sheet(views), cv2.COLOR_RGB2BGR))
        yield kind, sum(len(frames) for frames in clips.values()), path


def _spread(clips: Mapping[str, Sequence[int]]) -> list[tuple[str, int]]:
    """Return frames of the clips with the most failures, the middle one of each before others."""
    order = sorted(clips, key=lambda clip: -len(clips[clip]))
    shares = (0.5, 0.1, 0.9, 0.3, 0.7)
    places = [
        (clip, clips[clip][int(share * len(clips[clip]))]) for share in shares for clip in order
    ]
    return list(dict.fromkeys(places))[:_PER_KIND]


def _drawing(clip: str, t: int, found: Found, labels: Labels) -> np.ndarray:
    """Draw the image's border, the face, forearms by the labels, and the measured hands as crosses."""
    import cv2

    scale = 0.8 * min(_WIDTH / found.size[0], (_HEIGHT - 20) / found.size[1])
    image = np.full((_HEIGHT, _WIDTH, 3), _PAPER, np.uint8)
    left, top = (_WIDTH - scale * found.size[0]) / 2, 28.0

    def at(point: Tensor) -> tuple[int, int]:
        x, y = point.nan_to_num(-1e3).clamp(-1e4, 1e4).tolist()
        return round(left + scale * x), round(top + scale * y)

    corners = [at(torch.tensor(corner)) for corner in ((0.0, 0.0), [float(x) for x in found.size])]
    cv2.rectangle(image, *corners, _INK, 1)
    face = found.faces[t]
    cv2.circle(image, at(face[:2]), round(scale * float(face[2]) / 2), _INK, 1)
    for side, colour in enumerate(_COLOURS):
        hand, elbow = labels.centres[t, side], labels.centres[t, 2 + side]
        cv2.line(image, at(elbow), at(hand), colour, 1, cv2.LINE_AA)
        if int(labels.seen[t, side]) == 1:
            cv2.circle(image, at(hand), round(scale * labels.width / 4), colour, 1, cv2.LINE_AA)
        if bool(found.measured[t, 0, side]):
            cv2.drawMarker(image, at(found.points[t, 0, side]), colour, cv2.MARKER_CROSS, 12, 2)
    cv2.putText(image, f"{clip} {t}", (6, 16), 0, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return image
