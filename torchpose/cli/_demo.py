"""`torchpose demo`: an animated performer tracked in video or from keypoints, or a walk in three cameras."""

import re
from typing import Literal

from torchpose.cli._command import Command, Given
from torchpose.cli._common import pictures_possible
from torchpose.errors import InputError

_EXAMPLES = """
torchpose demo --out demo-output
torchpose demo --out demo-output --seed 3 --seconds 10
torchpose demo --out demo-output --input keypoints
torchpose demo --out demo-output/walk --input walk
torchpose demo --out demo-output --prior prior.safetensors"""
_SECONDS = {"video": 20.0, "keypoints": 20.0, "walk": 2.5}
_MOST_SECONDS = {"video": 3600, "keypoints": 3600, "walk": 4}  # then they are past the cameras
_VIDEO_FILES = ("clip.mp4", "truth.npz")
_KEYPOINT_FILES = ("keypoints.npz", "pose_3d.png", "errors.png")


def main(arguments: list[str]) -> int:
    """Run the command and return its exit code."""
    return Command("demo", run, _EXAMPLES).main(arguments)


def run(
    *,
    out: str,
    input: Literal["video", "keypoints", "walk"] = "video",
    prior: str = "kinect-upper-body",
    seed: int = 0,
    seconds: float | None = None,
    pictures: bool = True,
    given: Given,
) -> int:
    """Animate and render a performer, track the video, and score and draw the result.

    Or, with --input keypoints, track noisy keypoints of head, neck and hands with one hand hidden for a
    second; or, with --input walk, track a whole body in three cameras with a manifold of walking. Needs no
    data. Exit code 1 if the tracker does not beat the mean pose of its prior, or standing still.

    Args:
        out: folder of the results.
        input: what is tracked (default video; needs matplotlib for the performer's face).
        prior: a prior that comes with torchpose, or a .safetensors file; not for the walk.
        seed: seed of the performance and its noise.
        seconds: length; the performance takes 20 s and starts over (default 20; of the walk 2.5).
        pictures: draw pictures.
        given: the command.
    """
    from torchpose.cli._track_output import track_results
    from torchpose.priors._upper_body_prior import load_prior

    seconds = _SECONDS[input] if seconds is None else seconds
    most = _MOST_SECONDS[input]
    if not 1 <= seconds <= most:
        raise InputError(f"--seconds must be from 1 to {most}, got {seconds:g}")
    if input == "walk":
        from torchpose.cli._demo_walk import demo_walk

        given.refuse(("prior",), "the performer, and --input walk is tracked with a manifold")
        return demo_walk(out, seconds, seed, pictures_possible(pictures))
    from torchpose.cli._demo_keypoints import demo_keypoints
    from torchpose.cli._demo_video import demo_video

    model, pictures, video = load_prior(prior), pictures_possible(pictures), input == "video"
    expected = _VIDEO_FILES if video else (_KEYPOINT_FILES if pictures else _KEYPOINT_FILES[:1])
    own = "|".join(map(re.escape, (*_VIDEO_FILES, *_KEYPOINT_FILES)))
    with track_results(out, given.files(), pictures, video, expected, own) as results:
        print(
            "This is a smoke test on an animated performer, with made-up movements and noise.\n"
            "For the accuracy on people see `torchpose evaluate`.\n"
        )
        demo = demo_video if video else demo_keypoints
        return demo(model, results, seconds, seed, pictures)
