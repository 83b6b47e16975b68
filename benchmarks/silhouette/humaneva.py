"""HumanEva-I in the protocol Silhouette: its own partitions, calibration and videos.

The data set's part for validation is tracked, as in the paper, since its part for tests has no public
motion capture. The manifold comes from trials that were recorded without cameras, noise and exponents
from the part of the filmed trial that is for training. Silhouettes are those of its videos against
its videos of the empty room.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from numpy.typing import NDArray
from torch import Tensor
from tqdm.auto import tqdm

from benchmarks.bodies.clips import Split, select_persons, take_frames, whole_frames
from benchmarks.engine import kept_runs, source_hash
from benchmarks.humaneva_files import FPS, PARTITIONS, HumanEvaTrial, find_humaneva, read_humaneva
from torchpose.camera import CameraRig
from torchpose.errors import InputError
from torchpose.io._mocap import MocapClip
from torchpose.video import SilhouetteMeasurer, VideoSource, open_video, read_silhouettes
from torchpose.video._silhouettes import SilhouetteView, clean_silhouette, fit_view, learning_frames

ACTIONS = ("Walking", "Jog")
"""The paper's."""

_FILMED = "1"  # the trial with videos and motion capture
_WITHHELD = "2"  # the data set's test trial: whoever has its motion capture shall not train on it
_MANIFOLD_FRAMES, _VALIDATION_FRAMES = 350, 300
_LEAST_FRAMES = 20  # of a piece between two gaps
_MEASURED_WITH = (
    "torchpose/camera", "torchpose/measure/_brightness_background.py", "torchpose/video",
    "benchmarks/humaneva_files.py", "benchmarks/silhouette/humaneva.py",
)  # fmt: skip

Measure = Callable[[NDArray[np.uint8]], NDArray[np.bool_]]


class _Material(NamedTuple):
    """What one person shows of one action.

    Attributes:
        test: clip to track. filmed: for noise, exponents and body; unfilmed: for the manifold; both
            without gaps.
    """

    test: MocapClip
    filmed: tuple[MocapClip, ...]
    unfilmed: tuple[MocapClip, ...]


def humaneva_splits(
    root: str | Path,
    footage: "HumanEvaFootage",
    actions: Sequence[str] = (),
    test_actions: Sequence[str] = (),
    train_persons: Sequence[str] = (),
    test_persons: Sequence[str] = (),
) -> list[Split]:
    """Return a split for every action and person.

    Args:
        root: the data set. footage: is told where the frames of each clip are.
        actions: the paper's two if empty. test_actions: tracked with the manifold of `actions`, which
            is one then.
        train_persons, test_persons: everybody with a filmed trial if empty.

    Raises:
        InputError: no such action or person, nobody with a filmed trial, or too few frames.
    """
    pairs = [(action, action) for action in actions or ACTIONS]
    if test_actions:
        if len(actions) != 1:
            raise InputError(
                "--test-actions needs one action for the manifold: name it with --actions"
            )
        pairs = [(actions[0], action) for action in test_actions]
    known = {
        action: _materials(root, action, footage)
        for action in dict.fromkeys(action for pair in pairs for action in pair)
    }
    return [
        split
        for training, tracked in pairs
        for split in _splits(known[training], known[tracked], train_persons, test_persons)
    ]


def _splits(
    training: Mapping[str, _Material],
    tracked: Mapping[str, _Material],
    train_persons: Sequence[str],
    test_persons: Sequence[str],
) -> Iterator[Split]:
    trainers = _chosen(training, train_persons)
    for person in _chosen(tracked, test_persons):
        seen = person in trainers
        pool = [training[name] for name in ([person] if seen else trainers)]
        share = math.ceil(_MANIFOLD_FRAMES / len(pool))
        yield Split(
            person,
            (tracked[person].test,),
            tuple(clip for one in pool for clip in take_frames(one.unfilmed, share)),
            take_frames([clip for one in pool for clip in one.filmed], _VALIDATION_FRAMES),
            take_frames(tracked[person].filmed, _MANIFOLD_FRAMES),
            seen,
        )


def _chosen(materials: Mapping[str, _Material], persons: Sequence[str]) -> list[str]:
    return list(select_persons([one.test for one in materials.values()], persons))


# --- clips of the data set ------------------------------------------------------------------------


def _materials(root: str | Path, action: str, footage: "HumanEvaFootage") -> dict[str, _Material]:
    """Return everybody whose filmed trial of an action has its videos."""
    trials = find_humaneva(root)
    numbers: dict[str, list[str]] = {}
    for person, name, number in trials:
        if name == action:
            numbers.setdefault(person, []).append(number)
    found = {}
    for person, own in numbers.items():
        if _FILMED not in own:
            continue
        trial = read_humaneva(root, person, action, _FILMED)
        if len(trial.videos) < len(trial.calibrations):
            continue
        others = [
            read_humaneva(root, person, action, number)
            for number in own
            if number not in (_FILMED, _WITHHELD)
        ]
        found[person] = _material(trial, others, footage)
    if not found:
        there = ", ".join(sorted({f"{name} of {person}" for person, name, _ in trials}))
        raise InputError(
            f"{root}: expected trial {_FILMED} of {action} with motion capture and videos of all "
            f"three colour cameras; there is motion capture of {there}"
        )
    return found


def _material(
    trial: HumanEvaTrial, others: Sequence[HumanEvaTrial], footage: "HumanEvaFootage"
) -> _Material:
    """Return the parts of the filmed trial, and the others as a whole."""
    end = min(len(trial), footage.frames_of(trial))
    halves = (1, end // 2, end)
    first, middle, last = PARTITIONS.get((trial.person, trial.action), halves)
    middle, last = min(middle, end), min(last, end)
    whole = whole_frames(trial.clip(first, middle)).nonzero()
    unfilmed = [piece for other in others for piece in _pieces(other, 1, len(other))]
    filmed = _pieces(trial, middle + 1, last)
    if not unfilmed:  # half of what was filmed
        half = (middle + 1 + last) // 2
        unfilmed, filmed = _pieces(trial, middle + 1, half), _pieces(trial, half + 1, last)
    if not (len(whole) and filmed and unfilmed):
        raise InputError(
            f"{trial.person} {trial.action}: expected frames {first} to {last} of trial {_FILMED} with "
            f"motion capture and videos, in pieces of {_LEAST_FRAMES} frames or more without a gap; "
            f"there are {len(trial)} frames of motion capture and {footage.frames_of(trial)} of the "
            "videos"
        )
    start = first + int(whole[0])
    test = _piece(trial, start, middle)
    for begin, clip in ((start, test), *filmed):
        footage.place(clip, trial, begin)
    return _Material(test, tuple(clip for _, clip in filmed), tuple(clip for _, clip in unfilmed))


def _pieces(trial: HumanEvaTrial, start: int, stop: int) -> list[tuple[int, MocapClip]]:
    """Return pieces between gaps of the frames `start` to `stop`, each with its first frame's number."""
    clip = trial.clip(start, stop)
    known = whole_frames(clip).int()
    edges = torch.diff(known, prepend=known.new_zeros(1), append=known.new_zeros(1))
    begins, ends = (edges == 1).nonzero()[:, 0].tolist(), (edges == -1).nonzero()[:, 0].tolist()
    return [
        (start + a, _piece(trial, start + a, start + b - 1))
        for a, b in zip(begins, ends, strict=True)
        if b - a >= _LEAST_FRAMES
    ]


def _piece(trial: HumanEvaTrial, start: int, stop: int) -> MocapClip:
    clip = trial.clip(start, stop)
    return replace(clip, trial=f"{clip.trial} from {start}")


# --- silhouettes of its videos --------------------------------------------------------------------


class _Place(NamedTuple):
    trial: HumanEvaTrial
    start: int  # frame of the trial, from one


class _Packed(NamedTuple):
    """Silhouettes, a bit for each pixel: [T, C, H, ceil(W / 8)]."""

    bits: UInt8[Tensor, "T C H K"]


class HumanEvaFootage:
    """Silhouettes of the data set's videos, measured once for each size and kept in a folder.

    A pixel belongs to the person if it differs from each of the backgrounds that were filmed in the
    course of the recordings; shadows do not. Without videos of the empty room OpenCV's mixture learns
    what stays in the trial's own video.

    Args:
        folder: where silhouettes are kept. progress: whether to show bars.
    """

    def __init__(self, folder: Path, progress: bool = False) -> None:
        self._folder, self._progress = folder, progress
        self._places: dict[tuple[str, str], _Place] = {}
        self._measured: dict[tuple[str, str, tuple[int, int]], tuple[CameraRig, _Packed]] = {}

    def place(self, clip: MocapClip, trial: HumanEvaTrial, start: int) -> None:
        """Say that a clip begins at a frame of a trial, numbered from one."""
        self._places[clip.person, clip.trial] = _Place(trial, start)

    def frames_of(self, trial: HumanEvaTrial) -> int:
        """Return the number of frames that all videos of a trial have, from the trial's first frame on."""
        counts = []
        for camera, path in trial.videos.items():
            with _open(path) as source:
                if source.n_frames is not None:
                    counts.append(source.n_frames - trial.first_frames[camera])
        return max(min(counts, default=len(trial)), 0)

    def sees(self, clip: MocapClip) -> bool:
        """Return whether a clip is a part of a filmed trial."""
        return (clip.person, clip.trial) in self._places

    def __call__(
        self, clip: MocapClip, size: tuple[int, int], n_cameras: int
    ) -> tuple[CameraRig, Bool[Tensor, "T C H W"]]:
        """Return the first cameras, scaled to (height, width), and what they see of a clip.

        Raises:
            InputError: more cameras than there are, a clip of no filmed trial, videos that end early.
        """
        if not self.sees(clip):
            raise InputError(f"{clip.person} {clip.trial}: there are no videos of this clip")
        trial, start = self._places[clip.person, clip.trial]
        if not 1 <= n_cameras <= len(trial.calibrations):
            raise InputError(
                f"{n_cameras} cameras are asked for, and there are {len(trial.calibrations)}"
            )
        rig, packed = self._of_trial(trial, size)
        bits = packed.bits[start - 1 : start - 1 + len(clip), :n_cameras]
        if len(bits) < len(clip):
            raise InputError(
                f"{clip.person} {clip.trial}: expected videos of {len(clip)} frames from frame "
                f"{start} on, got {len(bits)}; is a file cut short?"
            )
        silhouettes = np.unpackbits(bits.numpy(), axis=-1)[..., : size[1]].astype(bool)
        return rig.select(range(n_cameras)), torch.from_numpy(silhouettes)

    def _of_trial(self, trial: HumanEvaTrial, size: tuple[int, int]) -> tuple[CameraRig, _Packed]:
        key = (trial.person, trial.action, size)
        if key not in self._measured:
            views = _views(trial, size)
            facts = _facts(trial, views)
            (packed,) = kept_runs(
                self._folder, _Packed, facts, (0,), lambda _: [self._measure(trial, views)]
            )
            self._measured[key] = CameraRig([view.camera for view in views]), packed
        return self._measured[key]

    def _measure(self, trial: HumanEvaTrial, views: Sequence[SilhouetteView]) -> _Packed:
        title = f"silhouettes of {trial.person} {trial.action}"
        with ExitStack() as stack:
            sources = [stack.enter_context(_open(path)) for path in trial.videos.values()]
            measures = [
                _measure_of(view, trial.backgrounds[camera], path)
                for view, (camera, path) in zip(views, trial.videos.items(), strict=True)
            ]
            delays = [trial.first_frames[camera] for camera in trial.videos]
            frames = tqdm(
                read_silhouettes(sources, measures, delays), disable=not self._progress, desc=title
            )
            packed = [np.packbits(masks.numpy(), axis=-1) for masks in frames]
        if not packed:
            raise InputError(f"{title}: the videos end before the trial's first frame")
        return _Packed(torch.from_numpy(np.stack(packed)))


def _open(path: Path) -> VideoSource:
    """Open a video with its own frames, or a folder of them."""
    return open_video(path, fps=FPS if path.is_dir() else None)


def _views(trial: HumanEvaTrial, size: tuple[int, int]) -> list[SilhouetteView]:
    views = []
    for camera, path in zip(trial.calibrations, trial.videos.values(), strict=True):
        with _open(path) as source:
            views.append(fit_view(camera, source.size, *size))
    return views


def _measure_of(view: SilhouetteView, backgrounds: Sequence[Path], video: Path) -> Measure:
    """Return a measurer of what differs from all backgrounds, or from what stays in the video."""
    if not backgrounds:
        with _open(video) as source:
            return SilhouetteMeasurer(view, None, learning_frames(source))
    models = []
    for path in backgrounds:
        with _open(path) as source:
            models.append(SilhouetteMeasurer(view, learning_frames(source)))

    def measure(frame: NDArray[np.uint8]) -> NDArray[np.bool_]:
        return clean_silhouette(np.logical_and.reduce([model(frame) for model in models]))

    return models[0] if len(models) == 1 else measure


def _facts(trial: HumanEvaTrial, views: Sequence[SilhouetteView]) -> list[object]:
    """Return the inputs of silhouettes."""
    files = [*trial.videos.values(), *(p for paths in trial.backgrounds.values() for p in paths)]
    facts: list[object] = [source_hash(*_MEASURED_WITH), trial.person, trial.action]
    facts.append(sorted(trial.first_frames.items()))
    facts += [[path.name, path.stat().st_size, path.stat().st_mtime_ns] for path in files]
    facts += [v for view in views for v in (view.camera.matrix, view.source.distortions, view.size)]
    return [*facts, views[0].camera.image_size]
