"""`torchpose demo`: an animated performer tracked in video or from keypoints, or a walk in three cameras."""

import re
from typing import TYPE_CHECKING

from jsonargparse import ArgumentParser, Namespace

from torchpose.cli.common import add_seed, new_parser, pictures_possible
from torchpose.errors import InputError

if TYPE_CHECKING:
    from torchpose.io._results import ResultsFolder
    from torchpose.priors._upper_body import UpperBodyPrior

_EXAMPLES = """
torchpose demo --out demo-output
torchpose demo --out demo-output --seed 3 --seconds 10
torchpose demo --out demo-output --input keypoints
torchpose demo --out demo-output/walk --input walk
torchpose demo --out demo-output --prior prior.safetensors"""
_INPUTS = ("video", "keypoints", "walk")
_SECONDS = {"video": 20.0, "keypoints": 20.0, "walk": 2.5}
_MOST_SECONDS = {"video": 3600, "keypoints": 3600, "walk": 4}  # then they are past the cameras
_VIDEO_FILES = ("clip.mp4", "truth.npz")
_KEYPOINT_FILES = ("keypoints.npz", "pose_3d.png", "errors.png")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return run(build().parse_args(arguments))


def build() -> ArgumentParser:
    """Parser of the command."""
    parser = new_parser(
        "demo",
        "Animate and render a performer, track the video, and score and draw the result; or, with "
        "--input keypoints, track noisy keypoints of head, neck and hands with one hand hidden for a "
        "second; or, with --input walk, track a whole body in three cameras with a manifold of walking. "
        "Needs no data. Exit code 1 if the tracker does not beat the mean pose of its prior, or standing "
        "still.",
        _EXAMPLES,
    )
    add = parser.add_argument
    add("--out", type=str, required=True, metavar="DIR", help="folder of the results")
    add(
        "--input",
        type=str,
        default="video",
        metavar="video|keypoints|walk",
        help="what is tracked (default video; needs matplotlib for the performer's face)",
    )
    add(
        "--prior",
        type=str,
        default="kinect-upper-body",
        metavar="NAME|FILE",
        help="a prior that comes with torchpose, or a .safetensors file (default kinect-upper-body)",
    )
    add_seed(parser, "the performance and its noise")
    add(
        "--seconds",
        type=float,
        metavar="S",
        help="length; the performance takes 20 s and starts over (default 20; of the walk 2.5)",
    )
    add("--pictures", type=bool, default=True, metavar="true|false",
        help="draw pictures (default true)")  # fmt: skip
    return parser


def run(args: Namespace) -> int:
    """Perform, track, score, draw; exit code 1 if the mean pose, or standing still, is not beaten."""
    from torchpose.cli.track_output import track_results
    from torchpose.priors._upper_body import load_prior

    if args.input not in _INPUTS:
        raise InputError(f"--input must be one of {', '.join(_INPUTS)}, got {args.input!r}")
    args.seconds = _SECONDS[args.input] if args.seconds is None else args.seconds
    most = _MOST_SECONDS[args.input]
    if not 1 <= args.seconds <= most:
        raise InputError(f"--seconds must be from 1 to {most}, got {args.seconds:g}")
    if args.input == "walk":
        from torchpose.cli.demo_walk import demo_walk

        return demo_walk(args.out, args.seconds, args.seed, pictures_possible(args.pictures))
    prior = load_prior(args.prior)
    pictures = pictures_possible(args.pictures)
    video = args.input == "video"
    more = (*_VIDEO_FILES, *_KEYPOINT_FILES)
    expected = _VIDEO_FILES if video else (_KEYPOINT_FILES if pictures else _KEYPOINT_FILES[:1])
    own = "|".join(map(re.escape, more))
    with track_results(args, pictures, video, expected, own) as results:
        return _perform(args, prior, results, pictures)


def _perform(
    args: Namespace, prior: "UpperBodyPrior", results: "ResultsFolder", pictures: bool
) -> int:
    from torchpose.cli.demo_keypoints import demo_keypoints
    from torchpose.cli.demo_video import demo_video

    print(
        "This is a smoke test on an animated performer, with made-up movements and noise. It shows "
        "that\nthe tracker works, not how well it does on people: see `torchpose evaluate`.\n"
    )
    demo = demo_video if args.input == "video" else demo_keypoints
    return demo(prior, results, args.seconds, args.seed, pictures)
