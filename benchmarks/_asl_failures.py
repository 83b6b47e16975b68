"""Sheets of frames in which a hand was not found, by the kind of failure."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from benchmarks._asl_materials import Material
from benchmarks._sheets import sheet
from torchpose.measure._edges import edge_map


def draw_failures(
    folder: Path, materials: Mapping[str, Material], found: Mapping[str, Tensor]
) -> Iterator[tuple[str, int, Path]]:
    """Draw a sheet for each kind of failure, of at most eight frames that are not neighbours.

    Args:
        folder: for the sheets. materials: by clip. found: the hands of a tracker [T, 2, 2], by clip.

    Yields:
        Kind, number of hand-frames, and file.
    """
    import cv2

    kinds: dict[str, list[tuple[str, int]]] = {}
    for clip, material in materials.items():
        for t, kind in failures(found[clip], material):
            kinds.setdefault(kind, []).append((clip, t))
    folder.mkdir(parents=True, exist_ok=True)
    for kind, places in kinds.items():
        some = places[:: max(1, -(-len(places) // 8))][:8]
        views = [_view(clip, t, materials[clip], found[clip][t]) for clip, t in some]
        name = f"{kind.replace(' ', '-')}.jpg"
        quality = [cv2.IMWRITE_JPEG_QUALITY, 80]
        cv2.imwrite(str(folder / name), cv2.cvtColor(sheet(views), cv2.COLOR_RGB2BGR), quality)
        yield kind, len(places), folder / name


def failures(points: Tensor, material: Material) -> Iterator[tuple[int, str]]:
    """Yield the frames with a wrong hand, and the kind of failure."""
    truth, near = material.truth, material.tolerance
    for t, k in torch.nonzero(~truth.isnan().any(-1)).tolist():
        point, face = points[t, k], material.faces[t]
        if bool(point.isnan().any()):
            yield t, "missing"
        elif float((point - truth[t, k]).norm()) <= near:
            continue
        elif float((point - truth[t, 1 - k]).norm()) <= near:
            yield t, "at the other hand"
        elif float((point - face[:2]).norm()) <= 0.8 * float(face[2]):
            yield t, "on the face"
        elif float((point - truth[t, k]).norm()) <= 2 * near:
            yield t, "beside the hand"
        else:
            yield t, "elsewhere"


def _view(clip: str, t: int, material: Material, points: Tensor) -> np.ndarray:
    """Draw the edges of a frame with true and found hands; the recordings must not be copied."""
    import cv2

    grey = cv2.cvtColor(material.frames[t], cv2.COLOR_RGB2GRAY)
    lines = np.where(edge_map(np.asarray(grey, np.uint8)).numpy(), 60, 255).astype(np.uint8)
    image = cv2.cvtColor(lines, cv2.COLOR_GRAY2RGB)
    for k, colour in enumerate(((0, 160, 0), (220, 0, 0))):
        if not bool(material.truth[t, k].isnan().any()):
            x, y = (int(v) for v in material.truth[t, k])
            cv2.circle(image, (x, y), round(material.tolerance), colour, 2)
        if not bool(points[k].isnan().any()):
            at = tuple(int(v) for v in points[k])
            cv2.drawMarker(image, at, (255, 255, 255), cv2.MARKER_CROSS, 40, 7)
            cv2.drawMarker(image, at, colour, cv2.MARKER_CROSS, 36, 3)
    cv2.putText(image, f"{clip} {t}", (8, 40), 0, 1.2, (0, 0, 0), 5)
    cv2.putText(image, f"{clip} {t}", (8, 40), 0, 1.2, (255, 255, 255), 2)
    small = cv2.resize(image, (280, 210), interpolation=cv2.INTER_AREA)
    return np.asarray(small)
