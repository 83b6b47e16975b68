"""`torchpose track`: video or 2D keypoints to 2D and 3D poses with covariances."""

from argparse import ArgumentError
from pathlib import Path
from typing import Any

from jsonargparse import ArgumentParser, Namespace

from torchpose.cli.common import add_seed, new_parser

_EXAMPLES = """
torchpose track clip.mp4 --out result
torchpose track 0 --out result
torchpose track frames/ --out result --fps 25 --background true
torchpose track keypoints.npz --out result
torchpose track openpose_json/ --out result --camera 525,525,319.5,239.5 --nose-as-head true
torchpose track keypoints.csv --out result --prior prior.safetensors --smoothing full
torchpose track keypoints.npz --out result --method pf-mixture --n-particles 10000 --seed 1
torchpose track keypoints.npz --out result --print_config > track.yaml
torchpose track --config track.yaml"""
_JOINT_STDS = 5
_KEYPOINT_FILES = (".npz", ".csv")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return run(build().parse_args(arguments))


def build() -> ArgumentParser:
    """Parser of the command."""
    from torchpose.upper_body._methods import METHODS

    parser = new_parser(
        "track",
        "Track everybody in a video, a folder of images or the picture of a camera; or a person from "
        "2D keypoints of head, neck and hands, or any others of the upper body, gaps and all. Writes "
        "poses.npz, poses.csv, poses.bvh and pictures into a folder, of video also overlay.mp4 and "
        "report.html.",
        _EXAMPLES,
    )
    add = parser.add_argument
    add(
        "input",
        type=str,
        metavar="INPUT",
        help="a video file, a folder of images, or the number of a camera; or keypoints: .npz, .csv or "
        "a folder of OpenPose JSON files. Digits are a camera only if no such path exists",
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
        metavar="METHOD",
        help=f"one of {', '.join(METHODS)}; by default window-mixture if the prior brings windows that "
        "suit, else mkf-fixed",
    )
    add(
        "--camera",
        type=str,
        metavar="FILE|fx,fy,cx,cy",
        help="TOML file or four numbers in pixels; without it K or the image size of the input",
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
        help="use N later frames, or all of them, for each estimate (window-mixture and mkf-fixed)",
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
        type=bool | None,
        default=None,
        metavar="true|false",
        help="deprecated: false stands for --method mkf-fixed, true for the default",
    )
    add(
        "--steady",
        type=bool | None,
        default=None,
        metavar="true|false",
        help="take the trembling out of what windows give, by filters of constant velocity (default "
        "true for window-mixture)",
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
        help="frames per second, if the input does not say or errs; a video file is resampled to it",
    )
    add(
        "--max-gap",
        type=float | None,
        default=5.0,
        metavar="S",
        help="longest stretch without any keypoint, in seconds, null for no bound (default 5); in "
        "video, somebody who is away for longer has no pose until they come back",
    )
    add_seed(parser, "the methods that draw")
    add(
        "--hands",
        type=str,
        default="grid",
        metavar="grid|mean-shift",
        help="video: how hands are found (default grid; mean-shift is the paper's recipe)",
    )
    add(
        "--background",
        type=bool,
        default=False,
        metavar="true|false",
        help="video: tell what moves from what does not, for a camera that stands still (default "
        "false)",
    )
    add(
        "--edges",
        type=bool,
        default=False,
        metavar="true|false",
        help="video: correct hands that were taken for each other by the edges of the arms (default "
        "false)",
    )
    add(
        "--candidates",
        type=bool,
        default=False,
        metavar="true|false",
        help="video: look for hands where the last pose has them as well; slower (default false)",
    )
    add(
        "--elbows",
        type=bool,
        default=False,
        metavar="true|false",
        help="video: measure elbows where the torso with its sleeves is widest (default false)",
    )
    add(
        "--face-model",
        type=str,
        metavar="FILE",
        help="video: a face detector of MediaPipe (.tflite) in place of OpenCV's cascade; needs "
        "mediapipe",
    )
    add("--max-persons", type=int, metavar="N", help="video: follow only the N largest faces")
    add(
        "--overlay",
        type=bool,
        default=True,
        metavar="true|false",
        help="video: write overlay.mp4 and report.html (default true)",
    )
    add("--pictures", type=bool, default=True, metavar="true|false",
        help="draw pose_strip.png and joint_curves.png (default true)")  # fmt: skip
    return parser


def run(args: Namespace) -> int:
    """Track, write and report; every check comes before any work."""
    if is_video(args.input):
        from torchpose.cli.track_video import track_video

        return track_video(args)
    from torchpose.cli.track_keypoints import track_keypoints

    return track_keypoints(args)


def is_video(where: str) -> bool:
    """Whether it is a video, a folder of images or a camera, and not keypoints."""
    path = Path(where)
    if path.is_dir():
        return not any(path.glob("*.json"))
    return path.suffix.lower() not in _KEYPOINT_FILES


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
