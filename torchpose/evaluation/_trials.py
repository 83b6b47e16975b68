"""What the protocols share: test sequences, tracking, and what is kept so that a killed run goes on."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm.auto import tqdm

from torchpose._core.digests import digest_of
from torchpose._core.facade import package_version
from torchpose._core.files import write_npz
from torchpose._core.reading import read_npz
from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._projection import project
from torchpose.errors import InputError, TorchposeError
from torchpose.evaluation._report import RESULTS, Report
from torchpose.filters._lengths import inside_lengths
from torchpose.filters._recursive_filter import Generators
from torchpose.io._recordings import Recording
from torchpose.io._results import replace_own
from torchpose.learning._recipes.choosing import fingerprint
from torchpose.math._rotations import euler_to_matrix
from torchpose.priors._upper_body_prior import UpperBodyPrior
from torchpose.skeleton._joint_sets import UPPER_BODY
from torchpose.upper_body._estimator_table import choose_method
from torchpose.upper_body._upper_body_tracker import UpperBodyTracker

CAMERA = PinholeCamera(525.0, 525.0, 319.5, 239.5, 640, 480)
"""The camera that test sequences are seen by."""

TEST_ANGLES = (0.02, -0.05, 0.03)
"""Roll, pitch and yaw of the test camera, radians, R = Rz Rx Ry (BL 3)."""

TEST_TRANSLATION = (0.05, -0.2, 2.0)
"""Translation of the test camera, metres."""

MEASURED = ("head", "neck", "hand_left", "hand_right")
HANDS = (UPPER_BODY.index("hand_left"), UPPER_BODY.index("hand_right"))
_NECK = UPPER_BODY.index("neck")

Recipe = Callable[..., UpperBodyPrior]
"""recordings, n_components, seed, progress, name -> prior with its noise and calibration."""


def cached_prior(
    out: Path, recordings: Sequence[Recording], recipe: Recipe, progress: bool, **settings: Any
) -> UpperBodyPrior:
    """Fit a prior, or read it from `out` if the same one was fitted there before.

    The file's name holds a hash of the recipe's name and version (`VERSION` of its module, else the
    module's text and the version of torchpose), of the settings, and of all that the recordings hold.

    Args:
        out: folder. recordings: to fit to. recipe: see `Recipe`. progress: whether to show bars.
        settings: handed to the recipe.
    """
    facts: list[Any] = [recipe.__module__, recipe.__qualname__, _version_of(recipe), settings]
    facts.append(fingerprint(recordings))
    path = out / f"prior-{settings_hash(facts)}.safetensors"
    if path.is_file():
        try:
            return UpperBodyPrior.load(path)
        except TorchposeError:
            path.unlink()  # damaged: fit it again
    prior = recipe(recordings, progress=progress, **settings)
    prior.save(path)
    return prior


def _version_of(recipe: Recipe) -> str:
    """Return what changes with a recipe."""
    module = import_module(recipe.__module__)
    given = str(getattr(module, "VERSION", ""))
    if given:
        return given
    try:
        return f"{package_version()} {inspect.getsource(module)}"
    except (OSError, TypeError):  # typed into a console
        return package_version()


def settings_hash(facts: Sequence[Any]) -> str:
    """Return sixteen letters that change with any of these values; tensors count with all their numbers."""
    parts = (
        fact if isinstance(fact, Tensor) else json.dumps(fact, sort_keys=True, default=str)
        for fact in facts
    )
    return digest_of(parts)[:16]


def read_kept(path: Path, kind: Callable[..., Any], fields: tuple[str, ...]) -> Any:
    """Return a tuple of tensors that `keep` wrote, or None where there is none; damaged files are deleted.

    Args:
        path: the file. kind: named tuple to be made of the tensors. fields: their names, in its order.
    """
    if not path.is_file():
        return None
    try:
        arrays = read_npz(path, fields)
    except TorchposeError:
        path.unlink()  # damaged: made again
        return None
    return kind(*(torch.from_numpy(arrays[key]) for key in fields))


def keep(path: Path, value: Any) -> None:
    """Write a NamedTuple of tensors, whole or not at all."""
    write_npz(path, {key: tensor.numpy() for key, tensor in value._asdict().items()})


class Trials(NamedTuple):
    """Sequences seen by the test camera; past the length of a sequence all is NaN.

    Attributes:
        truth3d: [B, T, 8, 3], camera axes, metres. truth2d: [B, T, 8, 2], pixels.
        keypoints: with noise, [B, T, M, 2]. lengths: [B]. fps: frame rate.
        names: the names of the M measured joints.
    """

    truth3d: Float[Tensor, "B T 8 3"]
    truth2d: Float[Tensor, "B T 8 2"]
    keypoints: Float[Tensor, "B T M 2"]
    lengths: Int[Tensor, " B"]
    fps: float
    names: tuple[str, ...] = MEASURED

    @property
    def inside(self) -> Bool[Tensor, "B T"]:
        """Return the frame mask [B, T], True up to the length of each sequence."""
        return inside_lengths(self.lengths, self.truth3d.shape[1])


def centred_on_neck(joints: Float[Tensor, "T 8 3"]) -> Float[Tensor, "T 8 3"]:
    """Return every frame moved so that its own neck is the origin."""
    return joints - joints[:, _NECK : _NECK + 1]


def make_test_set(
    poses: Sequence[Float[Tensor, "T 8 3"]],
    camera: PinholeCamera,
    fps: float,
    seed: int = 0,
    noise_std: float = 3.0,
    paths: Sequence[Float[Tensor, "T 3"]] | None = None,
    names: tuple[str, ...] = MEASURED,
) -> Trials:
    """Project poses into the test camera and measure some joints with Gaussian noise.

    Args:
        poses: one tensor for each sequence, metres, centred, camera axes.
        camera: the camera of the test. fps: frame rate.
        seed: the seed of the noise, which is independent over joints, frames and coordinates.
        noise_std: pixels. paths: translation of the whole body in each frame, metres.
        names: the names of the measured joints; by default head, neck and hands.

    Raises:
        InputError: no sequences, or a missing joint.
    """
    if not poses:
        raise InputError("a test needs at least one sequence, got none")
    lengths = torch.tensor([len(p) for p in poses])
    joints = torch.nn.utils.rnn.pad_sequence([p.double() for p in poses], True)
    rotation = euler_to_matrix(torch.tensor(TEST_ANGLES, dtype=torch.float64), "zxy")
    place = torch.tensor(TEST_TRANSLATION, dtype=torch.float64).expand(*joints.shape[:2], 3)
    if paths is not None:
        place = place + torch.nn.utils.rnn.pad_sequence([p.double() for p in paths], True)
    truth3d = joints @ rotation.mT + place[..., None, :]
    truth2d = project(joints, camera.matrix, rotation, place)[..., :2]
    generator = torch.Generator().manual_seed(seed)
    measured = [UPPER_BODY.index(name) for name in names]
    shape = (*joints.shape[:2], len(names), 2)
    noise = torch.randn(shape, generator=generator, dtype=torch.float64)
    keypoints = truth2d[:, :, measured] + noise_std * noise
    test = Trials(truth3d, truth2d, keypoints, lengths, fps, names)
    outside = ~test.inside
    if not bool(torch.isfinite(truth3d[~outside]).all()):
        raise InputError("test sequences must hold all eight joints, got missing ones")
    for tensor in (truth3d, truth2d, keypoints):
        tensor[outside] = torch.nan
    return test


class Estimate(NamedTuple):
    """Holds the poses of a method: joints2d [B, T, 8, 2], joints3d [B, T, 8, 3], covariance3d or None."""

    joints2d: Tensor
    joints3d: Tensor
    covariance3d: Tensor | None = None


def own_method(prior: UpperBodyPrior, fps: float | None, smoothing: int | str | None) -> str:
    """Return the default method of a prior: windows where they suit, else single poses."""
    return choose_method(prior, None, smoothing, fps, (), windows=True).method


def track(
    prior: UpperBodyPrior,
    camera: PinholeCamera,
    test: Trials,
    mask: Bool[Tensor, "B T M"] | None = None,
    *,
    chunk: int = 32,
    progress: bool = False,
    label: str = "",
    generator: Generators = None,
    method: str | None = None,
    **options: Any,
) -> Estimate:
    """Run `UpperBodyTracker` over a test set, some sequences at a time.

    Args:
        prior: of the tracker. camera: the camera of the test. mask: [B, T, M], False = hidden.
        chunk: sequences at a time. progress, label: of the bar. generator: for methods that draw.
        method: of the tracker; without one `own_method`, since the prior over arms that comes with the
            package was fitted to many a person who is scored.
        options: the options of the tracker.
    """
    method = method or own_method(prior, test.fps, options.get("smoothing"))
    tracker = UpperBodyTracker(
        prior, camera, method, fps=test.fps, neck=prior.info.neck, max_gap=None, **options
    )
    parts = []
    starts = range(0, len(test.lengths), chunk)
    for start in tqdm(starts, disable=not progress, desc=label, leave=False):
        rows = slice(start, start + chunk)
        longest = int(test.lengths[rows].max())
        own = generator[rows] if isinstance(generator, Sequence) else generator
        with torch.inference_mode():
            poses = tracker(
                test.keypoints[rows, :longest],
                names=test.names,
                mask=None if mask is None else mask[rows, :longest],
                lengths=test.lengths[rows],
                generator=own,
            )
        pad = test.truth3d.shape[1] - longest
        parts.append(
            [_padded(x, pad) for x in (poses.joints2d, poses.joints3d, poses.covariance3d)]
        )
    return Estimate(*(torch.cat(values) for values in zip(*parts, strict=True)))


def add_picture(report: Report, out: Path, name: str, figure: Any) -> None:
    """Write a matplotlib figure to the folder and list it in the report."""
    from torchpose.viz._style import save_figure

    with replace_own(out / name, RESULTS) as temporary:
        save_figure(figure, temporary)
    report.pictures.append(name)


def draw_picture(report: Report, out: Path, name: str, draw: Callable[[], Any]) -> None:
    """Draw a figure and add it to the report; without matplotlib, say in the report that it is missing."""
    if find_spec("matplotlib") is None:
        report.findings.append(f"{name} was not drawn: matplotlib is not installed.")
        return
    add_picture(report, out, name, draw())


def _padded(value: Tensor, pad: int) -> Tensor:
    """Repeat the last frame `pad` times."""
    if pad == 0:
        return value
    return torch.cat([value, value[:, -1:].expand(-1, pad, *value.shape[2:])], 1)
