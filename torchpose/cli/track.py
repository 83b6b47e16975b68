"""`torchpose track`: 2D keypoints of a person to 2D and 3D poses with covariances."""

import sys
import warnings
from argparse import ArgumentError
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jsonargparse import ArgumentParser, Namespace

from torchpose.cli.common import (
    add_seed,
    new_parser,
    pictures_possible,
    positive,
    save_pictures,
    show_progress,
)
from torchpose.errors import DegenerateFilterWarning, InputError

if TYPE_CHECKING:
    from torchpose.io import Keypoints
    from torchpose.pose_track import PoseTrack

_EXAMPLES = """
torchpose track keypoints.npz --out result
torchpose track openpose_json/ --out result --camera 525,525,319.5,239.5 --nose-as-head true
torchpose track keypoints.csv --out result --prior prior.safetensors --smoothing full
torchpose track keypoints.npz --out result --method pf-mixture --n-particles 10000 --seed 1
torchpose track keypoints.npz --out result --print_config > track.yaml
torchpose track --config track.yaml"""
_JOINT_STDS = 5


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return run(build().parse_args(arguments))


def build() -> ArgumentParser:
    """Parser of the command."""
    parser = new_parser(
        "track",
        "Track a person from 2D keypoints of head, neck and hands, or any others of the upper body, "
        "gaps and all. Writes poses.npz, poses.csv and pictures into a folder.",
        _EXAMPLES,
    )
    add = parser.add_argument
    add(
        "keypoints",
        type=str,
        metavar="KEYPOINTS",
        help=".npz, .csv or a folder of OpenPose JSON files",
    )
    add("--out", type=str, required=True, metavar="DIR", help="folder of the results")
    add(
        "--prior",
        type=str,
        default="kinect-upper-body",
        metavar="NAME|FILE",
        help="a prior that comes with torchpose, or a .safetensors file (default kinect-upper-body)",
    )
    add(
        "--method",
        type=str,
        default="mkf-fixed",
        metavar="METHOD",
        help="mkf-fixed (default), mkf-sampled, mkf-split, pf-mixture, pf-walk, pf-walk-unscaled",
    )
    add(
        "--camera",
        type=str,
        metavar="FILE|fx,fy,cx,cy",
        help="TOML file or four numbers in pixels; without it K or image_size of the keypoint file",
    )
    add("--camera-name", type=str, metavar="NAME", help="which camera of a file with several")
    add(
        "--measurement-std",
        type=parse_stds,
        metavar="PX",
        help="standard deviation of a keypoint in pixels: one number, or five with commas for hand, "
        "elbow, shoulder, head, neck; by default what the prior learnt, else 3",
    )
    add(
        "--smoothing",
        type=parse_smoothing,
        metavar="N|full",
        help="use N later frames, or all of them, for each estimate (mkf-fixed only)",
    )
    add("--n-particles", type=int, metavar="N", help="particles of the pf methods (default 10000)")
    add("--n-tracks", type=int, metavar="N", help="tracks of mkf-sampled and mkf-split")
    add(
        "--frame",
        type=str,
        default="camera",
        metavar="camera|body",
        help="axes of the 3D poses: of the camera (default) or of the body",
    )
    add(
        "--static-camera",
        type=bool,
        default=False,
        metavar="true|false",
        help="let the body turn in front of a camera that stays where it is (default false)",
    )
    add(
        "--window",
        type=bool,
        default=True,
        metavar="true|false",
        help="use the prior's mixtures over short windows of motion, if it brings them (mkf-fixed "
        "only); false tracks single poses, as the paper does (default true)",
    )
    add(
        "--steady",
        type=bool,
        default=True,
        metavar="true|false",
        help="take the trembling out of what windows give, by filters of constant velocity (default "
        "true)",
    )
    add(
        "--neck",
        type=str,
        metavar="KIND",
        help="kind of the keypoints' neck if their names do not tell: neck, low-neck, mid-shoulder",
    )
    add(
        "--nose-as-head",
        type=bool,
        default=False,
        metavar="true|false",
        help="take a nose for the head where there is none (default false)",
    )
    add(
        "--fps",
        type=float,
        metavar="HZ",
        help="frames per second, if the file does not say or errs",
    )
    add(
        "--max-gap",
        type=float | None,
        default=5.0,
        metavar="S",
        help="longest stretch without any keypoint, in seconds, null for no bound (default 5)",
    )
    add_seed(parser, "the methods that draw")
    add("--pictures", type=bool, default=True, metavar="true|false",
        help="draw pose_strip.png and joint_curves.png (default true)")  # fmt: skip
    return parser


def run(args: Namespace) -> int:
    """Track, write and report; every check comes before any work."""
    import torch

    from torchpose.cli.camera_option import resolve_camera
    from torchpose.io import check_output_folder, read_keypoints
    from torchpose.priors import load_prior
    from torchpose.tracking import UpperBodyTracker

    keypoints = read_keypoints(args.keypoints)
    for option, value in (("--fps", args.fps), ("--max-gap", args.max_gap)):
        positive(option, value)
    prior = load_prior(args.prior)
    camera, notes = resolve_camera(args.camera, args.camera_name, keypoints)
    names, more = _names(keypoints, args.nose_as_head)
    fps = args.fps or keypoints.fps
    if fps is None:
        more += (f"the keypoint file states no frame rate: {prior.info.fps or 30:g} fps assumed",)
    tracker = UpperBodyTracker(
        prior,
        camera,
        args.method,
        measurement_std=args.measurement_std,
        fps=fps,
        smoothing=args.smoothing,
        frame=args.frame,
        static_camera=args.static_camera,
        window=args.window,
        steady=args.steady,
        neck=_neck(args.neck, keypoints),
        max_gap=args.max_gap,
        **_filter_options(args),
    )
    pictures = pictures_possible(args.pictures)
    out = check_output_folder(args.out)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateFilterWarning)  # reported below in plain words
        track = tracker(
            keypoints.keypoints[None],
            None if keypoints.confidence is None else keypoints.confidence[None],
            names,
            generator=torch.Generator().manual_seed(args.seed),
            progress=show_progress(),
        )
    track = replace(track, notes=notes + more + track.notes)
    written = write_track(track, out, pictures)
    settings = {
        "prior": prior.info.name or args.prior,
        "camera": camera_text(camera),
        "method": args.method + _smoothing_text(args.smoothing),
    }
    print(summary(track, written, settings))
    return report_failure(track)


def write_track(track: "PoseTrack", out: Path, pictures: bool) -> list[Path]:
    """Write poses.npz, poses.csv and, if asked for, the pictures of one sequence."""
    from torchpose.cli.pose_csv import write_pose_csv

    track.save(out / "poses.npz")
    write_pose_csv(track, out / "poses.csv")
    written = [out / "poses.npz", out / "poses.csv"]
    if pictures and bool(track.joints3d.isfinite().all(-1).any()):
        written += save_pictures(out, track_pictures(track))
    return written


def track_pictures(track: "PoseTrack", truth: Any = None, labels: Any = None) -> dict[str, Any]:
    """Pictures of one sequence by file name, each as a function that draws it."""
    from torchpose import viz

    joints, observed, fps = track.joints3d[0], track.observed[0], track.fps or 30.0
    return {
        "pose_strip.png": lambda: viz.plot_pose_strip(
            joints, fps=fps, observed=observed, truth=truth, labels=labels, title="Tracked poses"
        ),
        "joint_curves.png": lambda: viz.plot_joint_curves(
            joints, track.covariance3d[0], observed, truth, fps=fps,
            title="Hands and elbows with 90 % bands",
        ),
    }  # fmt: skip


def summary(track: "PoseTrack", written: list[Path], settings: dict[str, str]) -> str:
    """A few lines for people: frames, what was measured, what was assumed, which files."""
    n, fps = track.joints3d.shape[1], track.fps
    length = f" ({n / fps:.1f} s at {fps:g} fps)" if fps else ""
    shares = track.observed[0].double().mean(0).tolist()
    seen = {name: share for name, share in zip(track.names, shares, strict=True) if share > 0}
    hidden = [name for name in track.names if name not in seen]
    measured = ", ".join(f"{name} {percent(share)}" for name, share in seen.items())
    return "\n".join(
        [
            f"frames   {n}{length}",
            *(f"{name:<9}{value}" for name, value in settings.items()),
            f"measured {measured}",
            *([f"inferred {', '.join(hidden)}"] if hidden else []),
            *(f"note     {note}" for note in track.notes),
            *(f"wrote    {path}" for path in written),
        ]
    )


def report_failure(track: "PoseTrack") -> int:
    """Exit code: 1 and a line on stderr if the filter degenerated, else 0."""
    at = int(track.failed_at[0])
    if at < 0:
        return 0
    print(
        f"torchpose: the filter degenerated at frame {at}; poses from there on are NaN. Measurements "
        "far from what the prior knows do that: check the camera and left and right, or raise "
        "--measurement-std",
        file=sys.stderr,
    )
    return 1


def camera_text(camera: Any) -> str:
    """Focal lengths and centre of a camera in a few words."""
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    return f"f = ({fx:g}, {fy:g}), centre ({cx:g}, {cy:g}) pixels"


def parse_stds(value: Any) -> float | list[float] | None:
    """One number or five, from text with commas, a number or a list."""
    parts = value.split(",") if isinstance(value, str) else value
    try:
        numbers = [float(p) for p in (parts if isinstance(parts, list) else [parts])]
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            None, f"--measurement-std must be a number or five with commas, got {value!r}"
        ) from error
    if len(numbers) not in (1, _JOINT_STDS):
        raise ArgumentError(
            None, f"--measurement-std must be one number or five (hand, elbow, shoulder, head, neck), "
            f"got {len(numbers)}"
        )  # fmt: skip
    return numbers[0] if len(numbers) == 1 else numbers


def parse_smoothing(value: Any) -> int | str:
    """A number of frames or "full"."""
    if value == "full":
        return "full"
    try:
        lag = int(str(value))
    except ValueError:
        lag = -1
    if lag < 0:
        raise ArgumentError(
            None, f"--smoothing must be a number of frames or 'full', got {str(value)!r}"
        )
    return lag


def _names(keypoints: "Keypoints", nose_as_head: bool) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names for the tracker, with the nose as head if asked for, and notes."""
    from torchpose.skeleton import canonical_names

    canonical = canonical_names(keypoints.names)
    if "head" in canonical:
        return keypoints.names, ()
    if not nose_as_head:
        hint = ("there is no head among the keypoints; --nose-as-head true takes the nose for it",)
        return keypoints.names, hint if "nose" in canonical else ()
    if "nose" not in canonical:
        raise InputError(f"--nose-as-head needs a nose, got {', '.join(keypoints.names)}")
    names = tuple(
        "head" if c == "nose" else name for c, name in zip(canonical, keypoints.names, strict=True)
    )
    return names, ("the nose stands for the head",)


def _neck(given: str | None, keypoints: "Keypoints") -> str | None:
    from torchpose.skeleton import NECK_KINDS

    if given is not None and given not in NECK_KINDS:
        raise InputError(f"--neck must be one of {', '.join(NECK_KINDS)}, got {given!r}")
    return given or keypoints.neck


def _filter_options(args: Namespace) -> dict[str, Any]:
    """Options of the filter that were given and that the method has."""
    from torchpose.tracking import METHODS

    if args.method not in METHODS:
        return {}  # the tracker refuses it, and lists those it knows
    has = {"n_particles": args.method.startswith("pf-"),
           "n_tracks": args.method in ("mkf-sampled", "mkf-split")}  # fmt: skip
    given = {name: getattr(args, name) for name in has if getattr(args, name) is not None}
    for name, value in given.items():
        option = f"--{name.replace('_', '-')}"
        if not has[name]:
            raise InputError(f"{option} does not apply to --method {args.method}")
        if value < 1:
            raise InputError(f"{option} must be at least 1, got {value}")
    return given


def _smoothing_text(smoothing: int | str | None) -> str:
    if smoothing is None:
        return ", filtered"
    return ", smoothed" if smoothing == "full" else f", smoothed with {smoothing} later frames"


def percent(share: float) -> str:
    """Rounded, but 100 % only for all."""
    return f"{min(100 * share, 99.9 if share < 1 else 100.0):.3g} %"
