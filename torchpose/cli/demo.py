"""`torchpose demo`: the animated performer, tracked in video or from keypoints, and scored."""

from jsonargparse import ArgumentParser, Namespace

from torchpose.cli.common import add_seed, new_parser, pictures_possible
from torchpose.errors import InputError

_EXAMPLES = """
torchpose demo --out demo-output
torchpose demo --out demo-output --seed 3 --seconds 10
torchpose demo --out demo-output --input keypoints
torchpose demo --out demo-output --prior prior.safetensors"""
_INPUTS = ("video", "keypoints")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return run(build().parse_args(arguments))


def build() -> ArgumentParser:
    """Parser of the command."""
    parser = new_parser(
        "demo",
        "Animate and render a performer, track the video, and score and draw the result; or, with "
        "--input keypoints, track noisy keypoints of head, neck and hands with one hand hidden for a "
        "second. Needs no data. Exit code 1 if the tracker does not beat the mean pose of its prior.",
        _EXAMPLES,
    )
    add = parser.add_argument
    add("--out", type=str, required=True, metavar="DIR", help="folder of the results")
    add(
        "--input",
        type=str,
        default="video",
        metavar="video|keypoints",
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
        default=20.0,
        metavar="S",
        help="length; the performance takes 20 s and starts over (default 20)",
    )
    add("--pictures", type=bool, default=True, metavar="true|false",
        help="draw pictures (default true)")  # fmt: skip
    return parser


def run(args: Namespace) -> int:
    """Perform, track, score, draw; exit code 1 if the mean pose is not beaten."""
    from torchpose.cli.demo_keypoints import demo_keypoints
    from torchpose.cli.demo_video import demo_video
    from torchpose.io import check_output_folder
    from torchpose.priors import load_prior

    if not 1 <= args.seconds <= 3600:
        raise InputError(f"--seconds must be from 1 to 3600, got {args.seconds:g}")
    if args.input not in _INPUTS:
        raise InputError(f"--input must be one of {', '.join(_INPUTS)}, got {args.input!r}")
    prior = load_prior(args.prior)
    pictures = pictures_possible(args.pictures)
    out = check_output_folder(args.out)
    print(
        "This is a smoke test on an animated performer, with made-up movements and noise. It shows "
        "that\nthe tracker works, not how well it does on people: see `torchpose evaluate`.\n"
    )
    demo = demo_video if args.input == "video" else demo_keypoints
    return demo(prior, out, args.seconds, args.seed, pictures)
