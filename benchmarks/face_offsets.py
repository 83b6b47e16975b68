"""Where head and neck of Kinect's skeletons are beside a face, and what other places would cost.

Two tables. The first: silhouettes of the eight persons of UTD-MHAD beside their skeletons, hands down;
how far crown and neck of the silhouette are from the head joint, in metres (medians). The second: the
seven clips of video_asl, tracked from their faces with head and neck put at several offsets, and from
MediaPipe's hands; how far the inferred elbows and shoulders are from MediaPipe's, in pixels, and the
mean score. MediaPipe's shoulders are higher than Kinect's, so theirs do not tell which offset is right.

    python -m benchmarks.face_offsets --data DIR
"""

from pathlib import Path

import av
import cv2
import numpy as np
import torch

from benchmarks._asl import CLIPS, SIZE, read_clip
from benchmarks._command import run_command
from benchmarks._data import data_files
from benchmarks._table_file import TableFile, save_text
from torchpose.camera import PinholeCamera
from torchpose.measure import HeadNeck
from torchpose.measure._face import FaceTracker
from torchpose.measure._head import FACE_OFFSETS
from torchpose.measure._upper_body_measurer import MEASURED, rounded_covariance
from torchpose.priors import load_prior
from torchpose.skeleton import UPPER_BODY
from torchpose.upper_body import UpperBodyTracker

HEADS, NECKS = (-0.4, -0.3, -0.2, -0.12, 0.0), (0.85, 0.95, 1.0, 1.1, 1.2)
HAND_STD = 8.0  # pixels
HANDS = ("hand_left", "hand_right")
INFERRED = ("elbow_left", "elbow_right", "shoulder_left", "shoulder_right")
BELOW = 0.25  # metres that hands have to be below the neck for a silhouette to count
COLUMNS = ("crown above head", "narrowest below", "neck joint below", "shoulders below")


def main(
    *, data: Path, out: TableFile | None = None, quick: bool = False, threads: int = 1
) -> None:
    """Print both tables.

    Args:
        data: folder of the data sets.
        out: file for the same as Markdown, or a folder.
        quick: one person, one clip, two offsets.
        threads: cores.
    """
    torch.set_num_threads(threads)
    tables = [silhouettes(data / "utd_mhad_silhouettes", quick), elbows(data / "video_asl", quick)]
    text = "\n\n".join(tables) + "\n"
    print(text, end="")
    save_text(out, text)


def silhouettes(folder: Path, quick: bool) -> str:
    """Return the table of crown, narrowest row, neck joint and shoulders, metres from the head joint."""
    by_person: dict[str, list[list[float]]] = {}
    for path in data_files(folder, "s01_*.npz" if quick else "s*.npz")[: 4 if quick else None]:
        by_person.setdefault(path.name[:3], []).extend(_heads(path))
    rows = {person: np.nanmedian(np.array(v), 0) for person, v in by_person.items() if v}
    rows["mean"] = np.mean(list(rows.values()), 0)
    lines = [f"| person | {' | '.join(COLUMNS)} |", "|---|" + "---:|" * len(COLUMNS)]
    lines += [f"| {p} | {' | '.join(f'{v:.3f}' for v in row)} |" for p, row in rows.items()]
    return "\n".join(lines)


def _heads(path: Path) -> list[list[float]]:
    """Return the four distances of each frame in which the hands are down."""
    with np.load(path) as file:
        joints, names, K = file["joints"], [str(n) for n in file["names"]], file["K"]
        masks = np.unpackbits(file["sil_packed"], axis=-1).reshape(file["sil_shape"])
        lag = int(file["mask_lag"])

    def pixels(name: str) -> np.ndarray:
        x, y, z = joints[:, names.index(name)].T
        return np.stack([K[0, 2] + K[0, 0] * x / z, K[1, 2] - K[1, 1] * y / z], -1)

    head, neck = pixels("head"), pixels("shoulder_center")
    shoulders = (pixels("left_shoulder") + pixels("right_shoulder")) / 2
    hands = np.minimum(pixels("left_hand")[:, 1], pixels("right_hand")[:, 1])
    scale = K[0, 0] / joints[:, names.index("head"), 2]
    found = []
    for t in np.flatnonzero(hands > neck[:, 1] + BELOW * scale):
        if t + lag < len(masks):
            rows = _crown_and_narrowest(masks[t + lag], head[t], neck[t, 1], scale[t])
            if rows is not None:
                below = (rows[0], rows[1], neck[t, 1], shoulders[t, 1])
                found.append([abs(row - head[t, 1]) / scale[t] for row in below])
    return found


def _crown_and_narrowest(
    mask: np.ndarray, head: np.ndarray, neck: float, scale: float
) -> tuple[int, int] | None:
    """Return the rows of the top of the head and of the narrowest part between head and neck, if seen."""
    u, v = (round(float(x)) for x in head)
    near, wide = int(0.16 * scale), int(0.35 * scale)
    if not wide < u < mask.shape[1] - wide:
        return None
    crown = np.flatnonzero(mask[: v + 1, u - near : u + near + 1].any(1))
    width = mask[:, u - wide : u + wide].sum(1)
    last = int(neck + 0.1 * scale)
    if not len(crown) or not v + 2 < last < mask.shape[0]:
        return None
    return int(crown[0]), v + int(np.argmin(width[v:last]))


def elbows(folder: Path, quick: bool) -> str:
    """Return the table of inferred elbows and shoulders beside MediaPipe's, for each pair of offsets."""
    clips = CLIPS[:1] if quick else CLIPS
    seen = {clip: _seen(folder, clip) for clip in clips}
    prior = load_prior("kinect-upper-body")
    camera = PinholeCamera.from_image_size(*SIZE)
    tracker = UpperBodyTracker(prior, camera, fps=30.0, max_gap=None)
    lines = [
        "| head (B) | neck (B) | elbow (px) | shoulder (px) | score |",
        "|---:|---:|---:|---:|---:|",
    ]
    pairs = [(a, b) for a in HEADS for b in NECKS][: 2 if quick else None]
    for head, neck in pairs:
        offsets = FACE_OFFSETS._replace(head=head, neck=neck)
        row = np.mean([_errors(tracker, HeadNeck(offsets), *seen[clip]) for clip in clips], 0)
        mark = " (used)" if (head, neck) == (FACE_OFFSETS.head, FACE_OFFSETS.neck) else ""
        lines.append(f"| {head:g} | {neck:g}{mark} | " + " | ".join(f"{v:.1f}" for v in row) + " |")
    return "\n".join(lines)


def _seen(folder: Path, clip: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the faces [T, 3] of a clip, and MediaPipe's hands [T, 2, 2], elbows and shoulders [T, 4, 2]."""
    tracker = FaceTracker()
    state, faces = tracker.init(), []
    with av.open(str(folder / f"{clip}.mkv")) as video:
        for frame in video.decode(video=0):
            grey = cv2.cvtColor(frame.to_ndarray(format="rgb24"), cv2.COLOR_RGB2GRAY)
            state = tracker.step(state, grey)
            used = torch.nonzero(tracker.usable(state)).flatten()
            longest = used[state.age[used].argmax()] if len(used) else None
            none = [float("nan")] * 3
            faces.append(none if longest is None else state.mean[longest, :3].tolist())
    found = read_clip(folder, clip)
    points = torch.where(found.known[..., None], found.points, torch.nan).numpy()
    hands, arms = (
        points[:, [UPPER_BODY.index(name) for name in names]] for names in (HANDS, INFERRED)
    )
    return np.array(faces), hands, arms


def _errors(
    tracker: UpperBodyTracker,
    head_neck: HeadNeck,
    faces: np.ndarray,
    hands: np.ndarray,
    arms: np.ndarray,
) -> tuple[float, float, float]:
    """Return the errors of elbow and shoulder, pixels, and the score of a clip."""
    n_frames = min(len(faces), len(hands))
    points, cov = head_neck(torch.from_numpy(faces[:n_frames]))
    hand_cov = HAND_STD**2 * torch.eye(2, dtype=torch.float64)
    keypoints = torch.cat([points, torch.from_numpy(hands[:n_frames])], 1)
    cov = torch.cat([cov, hand_cov.expand(n_frames, 2, 2, 2)], 1)
    there = keypoints.isfinite().all(-1)[..., None, None]
    cov = torch.where(there, rounded_covariance(cov.nan_to_num(1.0)), hand_cov)
    with torch.no_grad():
        track = tracker(keypoints[None], names=MEASURED, covariance=cov[None])
    found = track.joints2d[0, :, [UPPER_BODY.index(name) for name in INFERRED]].numpy()
    error = np.linalg.norm(found - arms[:n_frames], axis=-1)
    score = float(track.log_evidence.sum(-1).mean())
    return float(np.nanmean(error[:, :2])), float(np.nanmean(error[:, 2:])), score


if __name__ == "__main__":
    run_command(main)
