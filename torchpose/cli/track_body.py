"""`torchpose track-body`: videos of calibrated cameras to the 3D poses of a whole body."""

import sys
import time
from dataclasses import replace
from itertools import chain, islice
from typing import TYPE_CHECKING, Any

from jsonargparse import ArgumentParser, Namespace

from torchpose.cli.common import (
    add_seed,
    new_parser,
    pictures_possible,
    positive,
    share_cores,
    show_progress,
)
from torchpose.cli.track_body_output import draw, facts_of, summary, write_csv, write_page
from torchpose.cli.track_body_videos import Recordings
from torchpose.errors import CameraError, InputError

if TYPE_CHECKING:
    from torch import Tensor

    from torchpose.body.kinematics import Body
    from torchpose.body_poses import BodyPoses
    from torchpose.camera import PinholeCamera
    from torchpose.camera_rig import CameraRig
    from torchpose.filters.silhouette_filter import SilhouetteParticleFilter

_EXAMPLES = """
torchpose track-body cameras.toml cam1.mp4 cam2.mp4 cam3.mp4 --out result
torchpose track-body cameras.toml cam*.mp4 --background empty*.png --height 1.82 --out result
torchpose track-body cameras.toml cam*.mp4 --manifold walk.safetensors --out result
torchpose track-body cameras.toml cam*.mp4 --body result/body.npz --facing [1,0,0] --out again"""
METHODS = ("mrpf", "apf", "sir")
_LAYERS = 5  # of the annealed filter, each with its share of the particles
_RATE = 60.0  # frames per second for which the default noise of the filters is
_LOOK_AHEAD = 0.5  # seconds that decide where the person looks at first
_SEEN = 0.002  # of the image: fewer pixels are nobody


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return run(build().parse_args(arguments))


def build() -> ArgumentParser:
    """Parser of the command."""
    parser = new_parser(
        "track-body",
        "Track one person's whole body through the videos of calibrated cameras that stand still, by "
        "silhouettes and a particle filter. Writes body.npz, joints.csv, an overlay of every camera, "
        "report.html and a picture into a folder.",
        _EXAMPLES,
    )
    add = parser.add_argument
    add("cameras", type=str, metavar="CAMERAS",
        help="TOML file with a table per camera: size, matrix, distortions, and its pose")  # fmt: skip
    add("videos", type=str, nargs="+", metavar="VIDEO",
        help="a video or a folder of images per camera, in the order of the file, in step")  # fmt: skip
    add("--out", type=str, required=True, metavar="DIR", help="folder of the results")
    add("--camera-names", type=list[str] | None, default=None, metavar="NAMES",
        help="which cameras of the file the videos are of, if not all in order")  # fmt: skip
    add("--background", type=str, nargs="+", metavar="FILE",
        help="picture, folder of pictures or video of the empty scene per camera; without, what stays "
        "in a video is its background, so the person has to move about")  # fmt: skip
    add("--ignore-still", type=bool, default=False, metavar="true|false",
        help="with --background: what always looks the same in a video was moved since the scene was "
        "empty, and is no person; not for somebody who stands still (default false)")  # fmt: skip
    add("--method", type=str, metavar="mrpf|apf|sir",
        help="manifold-regularised (needs --manifold), annealed or plain particle filter (default mrpf "
        "with a manifold, else apf)")  # fmt: skip
    add(
        "--manifold",
        type=str,
        metavar="FILE",
        help="poses of an action, from `python -m train fit`",
    )
    add("--height", type=float, default=1.75, metavar="M",
        help="height of the person, metres (default 1.75)")  # fmt: skip
    add("--body", type=str, metavar="FILE",
        help="a body.npz whose bone lengths and shape the person has; then --height is not used")  # fmt: skip
    add("--initial-pose", type=str, metavar="FILE",
        help="a body.npz whose first pose the person begins with; without, it is found")  # fmt: skip
    add("--facing", type=list[float] | None, default=None, metavar="[x,y,z]",
        help="where the person looks at first, in world axes; without, the first steps and the bend of "
        "the knees tell, which one who walks backwards or stands straight gets wrong")  # fmt: skip
    add(
        "--rows", type=int, default=160, metavar="N", help="height of the silhouettes (default 160)"
    )
    add("--n-particles", type=int, default=1000, metavar="N",
        help="particles, of all layers together (default 1000)")  # fmt: skip
    add("--sharpness", type=float, default=100.0, metavar="X",
        help="exponent of the likelihood (default 100; the papers have 1)")  # fmt: skip
    add("--fps", type=float, metavar="HZ", help="rate at which all videos are read")
    add("--delays", type=list[int] | None, default=None, metavar="[n,n,...]",
        help="frames by which each video began too early (default none)")  # fmt: skip
    add_seed(parser, "the filter")
    add("--overlay", type=bool, default=True, metavar="true|false",
        help="write a video per camera with the body drawn into it (default true)")  # fmt: skip
    add("--pictures", type=bool, default=True, metavar="true|false",
        help="write overlay.png (default true)")  # fmt: skip
    return parser


def run(args: Namespace) -> int:
    """Track, write and report; exit code 1 if nobody was seen or the filter lost the person."""
    from torchpose.io import check_output_folder

    _check(args)
    share_cores()
    cameras = _cameras(args)
    body, manifold = _body(args), _manifold(args)
    out = check_output_folder(args.out)
    pictures = pictures_possible(args.pictures)
    with Recordings(args, cameras) as recordings:
        start = time.perf_counter()
        poses = _track(args, recordings, body, manifold)
        seconds = time.perf_counter() - start
        if poses is None:
            print(
                "torchpose: nobody was seen by all cameras, so there are no poses", file=sys.stderr
            )
            return 1
        poses.save(out / "body.npz")
        write_csv(out / "joints.csv", poses)
        written = [out / "body.npz", out / "joints.csv"]
        if args.overlay or pictures:
            written += draw(recordings, poses, out, args.overlay, pictures)
    facts = facts_of(args, recordings, poses, seconds)
    written += write_page(recordings, poses, facts, out)
    return summary(poses, facts, written)


def _check(args: Namespace) -> None:
    for option, value in (("--height", args.height), ("--sharpness", args.sharpness),
                          ("--rows", args.rows), ("--n-particles", args.n_particles),
                          ("--fps", args.fps)):  # fmt: skip
        positive(option, value)
    args.method = args.method or ("mrpf" if args.manifold else "apf")
    if args.method not in METHODS:
        raise InputError(f"--method must be one of {', '.join(METHODS)}, got {args.method!r}")
    if args.method == "mrpf" and not args.manifold:
        raise InputError("--method mrpf needs --manifold FILE, a manifold of the action's poses")
    if args.method != "mrpf" and args.manifold and args.initial_pose:
        raise InputError(f"--manifold does nothing for --method {args.method} with an initial pose")
    if args.facing is not None and len(args.facing) != 3:
        raise InputError(f"--facing must be three numbers, got {args.facing}")
    if args.ignore_still and not args.background:
        raise InputError("--ignore-still true needs --background")
    for option, given in (("--background", args.background), ("--delays", args.delays)):
        if given and len(given) != len(args.videos):
            raise InputError(
                f"{option} needs one entry for each of the {len(args.videos)} videos, "
                f"got {len(given)}"
            )


def _cameras(args: Namespace) -> "list[PinholeCamera]":
    from torchpose.camera import load_cameras

    found = load_cameras(args.cameras)
    names = list(found) if args.camera_names is None else args.camera_names
    missing = [name for name in names if name not in found]
    if missing or len(names) != len(args.videos):
        raise CameraError(
            f"{args.cameras}: expected a camera for each of the {len(args.videos)} videos, got "
            f"{', '.join(names)}; it holds {', '.join(found)} (choose by --camera-names)"
        )
    return [found[name] for name in names]


def _body(args: Namespace) -> "Body":
    from torchpose.body import BODY_15, Body
    from torchpose.body_poses import load_body

    return load_body(args.body) if args.body else Body.of_height(BODY_15, args.height)


def _manifold(args: Namespace) -> Any:
    if args.manifold is None:
        return None
    from torchpose.priors.gplvm import BackConstrainedGPLVM

    return BackConstrainedGPLVM.load(args.manifold)


def make_filter(
    method: str, body: "Body", manifold: Any, n_particles: int, sharpness: float, fps: float
) -> "SilhouetteParticleFilter":
    """The filter of a method; its diffusion grows with the time between frames."""
    from torchpose.filters import (
        AnnealedParticleFilter,
        ManifoldParticleFilter,
        SIRParticleFilter,
    )
    from torchpose.filters.silhouette_filter import default_step_std

    step = default_step_std(body) * (_RATE / fps) ** 0.5
    if method == "apf":
        return AnnealedParticleFilter(
            body,
            max(1, n_particles // _LAYERS),
            n_layers=_LAYERS,
            step_std=step,
            sharpness=sharpness,
        )
    if method == "sir":
        return SIRParticleFilter(body, n_particles, step_std=step, sharpness=sharpness)
    step[list(body.relative_columns)] = manifold.std_step.to(step)
    return ManifoldParticleFilter(
        body, manifold, n_particles, step_std=step, fps=fps, sharpness=sharpness
    )


def _track(
    args: Namespace, recordings: "Recordings", body: "Body", manifold: Any
) -> "BodyPoses | None":
    """Find the person, then track; None if there is nobody."""
    import torch

    from torchpose.body_tracking import track_body

    frames = recordings.silhouettes()
    first = next((masks for masks in frames if _all_see(masks)), None)
    if first is None:
        return None
    begun = len(recordings.packed) - 1
    generator = torch.Generator().manual_seed(args.seed)
    rig = recordings.rig
    looked_at = 1 if args.initial_pose else max(1, round(_LOOK_AHEAD * recordings.fps))
    begin = [first, *islice(frames, looked_at - 1)]
    start = _initial_state(args, body, begin, rig, manifold, recordings.fps, generator)
    model = make_filter(
        args.method, body, manifold, args.n_particles, args.sharpness, recordings.fps
    )
    expected = recordings.n_frames
    poses = track_body(
        model, chain(begin, frames), rig, start, generator, initial_std=2 * model.step_std,
        fps=recordings.fps, n_frames=None if expected is None else max(1, expected - begun),
        progress=show_progress(),
    )  # fmt: skip
    notes = (*recordings.notes, *(n for s in recordings.sources for n in s.notes))
    if begun:
        notes += (f"the first {begun} frames, in which not all cameras saw somebody, have no pose",)
    return replace(poses, first_frame=begun, notes=notes)


def _all_see(masks: "Tensor") -> bool:
    return bool((masks.double().mean((-2, -1)) > _SEEN).all())


def _initial_state(
    args: Namespace, body: "Body", begin: "list[Tensor]", rig: "CameraRig", manifold: Any, fps: float,
    generator: Any,
) -> "Tensor":  # fmt: skip
    import torch

    from torchpose.body.fitting import fit_state
    from torchpose.body_poses import BodyPoses
    from torchpose.filters.first_pose import find_first_pose

    if args.initial_pose:
        recorded = BodyPoses.load(args.initial_pose)
        return fit_state(body, recorded.joints3d[:1])[0]
    print("finding the pose of the first frame ...", flush=True)
    facing = None if args.facing is None else torch.tensor(args.facing, dtype=torch.float64)
    return find_first_pose(
        body, torch.stack(begin), rig, manifold, generator, fps=fps, facing=facing
    ).state
