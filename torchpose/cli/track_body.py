"""`torchpose track-body`: videos of calibrated cameras to the 3D poses of a whole body."""

import sys
import time
import warnings
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from jsonargparse import ArgumentParser, Namespace

from torchpose._core.terminal import check_positive, show_progress
from torchpose.cli.common import add_seed, new_parser, pictures_possible, share_cores
from torchpose.cli.track_body_output import (
    body_results,
    draw,
    facts_of,
    summary,
    write_page,
    write_poses,
)
from torchpose.cli.track_body_videos import Recordings
from torchpose.errors import CameraError, DegenerateFilterWarning, InputError, NobodySeenError

if TYPE_CHECKING:
    from torchpose.camera._pinhole import PinholeCamera
    from torchpose.whole_body._poses import BodyPoses
    from torchpose.whole_body._tracker import BodyTracker

_EXAMPLES = """
torchpose track-body cameras.toml cam1.mp4 cam2.mp4 cam3.mp4 --out result
torchpose track-body cameras.toml cam*.mp4 --background empty*.png --height 1.82 --out result
torchpose track-body cameras.toml cam*.mp4 --manifold walk --out result
torchpose track-body cameras.toml cam*.mp4 --method root --conditionals walk --out result
torchpose track-body cameras.toml cam1.mp4 --method constrained --action bend.safetensors --out result
torchpose track-body cameras.toml cam*.mp4 --body result/body.npz --facing [1,0,0] --out again"""
_LEARNT = ("manifold", "conditionals", "action")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return run(build().parse_args(arguments))


def build() -> ArgumentParser:
    """Return the parser of the command."""
    from torchpose.whole_body._methods import METHODS

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
    add("--method", type=str, metavar="|".join(METHODS),
        help="manifold-regularised (needs --manifold), annealed, plain, root hypotheses with Gaussian "
        "limbs (needs --conditionals), or constrained to an action (needs --action) particle filter "
        "(default what the file given is for, else apf)")  # fmt: skip
    add("--manifold", type=str, metavar="NAME|FILE",
        help="poses of an action, by a name that `torchpose info` lists, or a file")  # fmt: skip
    add("--conditionals", type=str, metavar="NAME|FILE",
        help="how limbs stand to each other and turn, by name, or a file")  # fmt: skip
    add("--action", type=str, metavar="NAME|FILE",
        help="postures of an action, or of several, by name, or a file")  # fmt: skip
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
        help="particles, of all layers together; a root hypothesis counts seven (default 1000)")  # fmt: skip
    add("--sharpness", type=float, metavar="X",
        help="exponent of the likelihood; not for root (default 100, of the overlap that constrained "
        "goes by 30; the papers have 1)")  # fmt: skip
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
    _check(args)
    share_cores()
    cameras = _cameras(args)
    learnt = _learnt(args)
    pictures = pictures_possible(args.pictures)
    with ExitStack() as stack:
        results = stack.enter_context(body_results(args, cameras, pictures))
        with Recordings(args, cameras) as recordings:
            start = time.perf_counter()
            tracker = _tracker(args, recordings, learnt)
            poses = _track(args, recordings, tracker)
            seconds = time.perf_counter() - start
            if poses is None:
                print(
                    "torchpose: nobody was seen by all cameras, so there are no poses",
                    file=sys.stderr,
                )
                return 1
            written = results.commit(write_poses(results.stage, poses))
            shown = []
            if args.overlay or pictures:
                shown = draw(recordings, poses, results.stage, args.overlay, pictures)
        facts = facts_of(args, tracker, recordings, poses, seconds)
        shown += write_page(recordings, poses, facts, results.stage)
        written += results.commit(shown)
    return summary(poses, facts, written, results.notes)


def _check(args: Namespace) -> None:
    for option, value in (("--height", args.height), ("--sharpness", args.sharpness),
                          ("--rows", args.rows), ("--n-particles", args.n_particles),
                          ("--fps", args.fps)):  # fmt: skip
        check_positive(option, value)
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
    from torchpose.camera._pinhole import load_cameras

    found = load_cameras(args.cameras)
    names = list(found) if args.camera_names is None else args.camera_names
    missing = [name for name in names if name not in found]
    if missing or len(names) != len(args.videos):
        raise CameraError(
            f"{args.cameras}: expected a camera for each of the {len(args.videos)} videos, got "
            f"{', '.join(names)}; it holds {', '.join(found)} (choose by --camera-names)"
        )
    return [found[name] for name in names]


def _learnt(args: Namespace) -> dict[str, Any]:
    """Return the models that the options name; refuse options that do not go together."""
    from torchpose.whole_body._methods import LEARNT, METHODS, check_options, choose_method

    given = {kind: getattr(args, kind) for kind in _LEARNT if getattr(args, kind)}
    method = choose_method(args.method, given)
    if args.sharpness is not None:
        check_options(method, ["sharpness"])
    if args.initial_pose and "manifold" in given and METHODS[method].needs != "manifold":
        raise InputError(f"--manifold does nothing for --method {method} with an initial pose")
    return {kind: LEARNT[kind].load(name) for kind, name in given.items()}


def _tracker(args: Namespace, recordings: "Recordings", learnt: dict[str, Any]) -> "BodyTracker":
    from torchpose.whole_body._tracker import BodyTracker

    options = {} if args.sharpness is None else {"sharpness": args.sharpness}
    return BodyTracker(
        recordings.rig, args.method, body=args.body, height=args.height, **learnt,
        n_particles=args.n_particles, fps=recordings.fps, **options,
    )  # fmt: skip


def _track(args: Namespace, recordings: "Recordings", tracker: "BodyTracker") -> "BodyPoses | None":
    """Find the person, then track; None if there is nobody."""
    import torch

    from torchpose.body._fitting import fit_state
    from torchpose.whole_body._poses import BodyPoses

    start, facing = None, None
    frames = recordings.silhouettes()
    if args.initial_pose:
        recorded = BodyPoses.load(args.initial_pose)
        start = fit_state(tracker.body, recorded.joints3d[:1])[0]
    else:
        print("finding the pose of the first frame ...", flush=True)
    if args.facing is not None:
        facing = torch.tensor(args.facing, dtype=torch.float64)
    generator = torch.Generator().manual_seed(args.seed)
    with warnings.catch_warnings():
        # said in a note, with the numbers of the frames
        warnings.filterwarnings("ignore", "the gate rejected", DegenerateFilterWarning)
        try:
            poses = tracker(
                frames, start, generator, show_progress(), facing=facing,
                n_frames=recordings.n_frames,
            )  # fmt: skip
        except NobodySeenError:
            return None
    notes = (*recordings.notes, *(n for s in recordings.sources for n in s.notes))
    return replace(poses, notes=(*notes, *poses.notes))
