"""Write joints as markers of a TRC file, which OpenSim reads."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from torchpose._core.checks import check_rate, check_shape
from torchpose._core.files import atomic_path


def write_trc(
    path: str | Path,
    joints: Float[Tensor, "T J 3"],
    names: Sequence[str],
    fps: float,
    *,
    first_frame: int = 0,
) -> None:
    """Write markers in metres as ``.trc``; the file appears whole or not at all.

    Frames are counted from 1, and time from 0, both from the beginning of the recording. Markers that are
    NaN are left empty.

    Args:
        path: the file, which is replaced. joints: metres, in the axes of the file.
        names: of the J markers. fps: frames per second.
        first_frame: number of the first frame in the recording, counted from 0.

    Raises:
        ShapeError: other joints. InputError: a rate that is not positive. OutputError: it cannot be written.
    """
    check_shape("joints", joints, [None, len(names), 3])
    rate = f"{check_rate('fps', fps):g}"
    n_frames, n_markers = len(joints), len(names)
    counts = f"{n_frames}\t{n_markers}\tm\t{rate}\t{first_frame + 1}\t{n_frames}"
    axes = [f"{axis}{i}" for i in range(1, n_markers + 1) for axis in "XYZ"]
    header = [
        f"PathFileType\t4\t(X/Y/Z)\t{Path(path).name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{counts}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        "\t\t" + "\t".join(axes),
        "",
    ]
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as stream:
        stream.write("\n".join(header) + "\n")
        stream.writelines(_rows(joints, fps, first_frame))


def _rows(joints: Float[Tensor, "T J 3"], fps: float, first_frame: int) -> Iterator[str]:
    """Return a line for each frame."""
    for frame, row in enumerate(joints.flatten(1).tolist(), start=first_frame):
        cells = ["" if value != value else f"{value:.6f}" for value in row]
        yield "\t".join([str(frame + 1), f"{frame / fps:.6f}", *cells]) + "\n"
