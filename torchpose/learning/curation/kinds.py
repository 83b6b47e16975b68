"""What one prior cannot be fitted to together: hands and wrists, heads and noses."""

from collections.abc import Sequence

from torchpose.errors import InputError, PriorError
from torchpose.io.recordings import Recording
from torchpose.learning.curation.upper import label

__all__ = ["check_kinds", "skeleton_counts"]

_SHOWN_FILES = 3


def check_kinds(recordings: Sequence[Recording]) -> None:
    """Raise unless all recordings mean the same by hand and head, as `collect_poses` will want.

    Necks are no matter: they are converted there.

    Raises:
        InputError: no recordings. PriorError: kinds are mixed; files of each kind are named.
    """
    if not recordings:
        raise InputError("expected at least one recording, got none")
    bodies = [recording.upper_body() for recording in recordings]
    _check("hand", recordings, [body.hand for body in bodies])
    _check("head", recordings, [body.head for body in bodies])


def skeleton_counts(recordings: Sequence[Recording]) -> dict[str, int]:
    """How many recordings there are of each joint set; those of no known set under ``other``."""
    names = sorted(r.skeleton or "other" for r in recordings)
    return {name: names.count(name) for name in dict.fromkeys(names)}


def _check(joint: str, recordings: Sequence[Recording], kinds: Sequence[str | None]) -> None:
    found = sorted({kind for kind in kinds if kind is not None})
    if len(found) < 2:
        return
    shown = "; ".join(f"{kind}: {_files(recordings, kinds, kind)}" for kind in found)
    raise PriorError(
        f"recordings must agree on what a {joint} is, got {' and '.join(found)} ({shown}); fit them "
        "apart, or leave one kind out"
    )


def _files(recordings: Sequence[Recording], kinds: Sequence[str | None], kind: str) -> str:
    files = [label(r) for r, own in zip(recordings, kinds, strict=True) if own == kind]
    more = len(files) - _SHOWN_FILES
    return ", ".join(files[:_SHOWN_FILES]) + (f" and {more} more" if more > 0 else "")
