"""Report what curation left out and changed, for the command line and for model cards."""

from collections import Counter
from collections.abc import Iterable
from typing import Any, NamedTuple

from torchpose._core.wording import counted
from torchpose.io._formats.raw_recording import frame_ranges

_SHOWN_NOTES = 20


class Drop(NamedTuple):
    """Describes the frames of one recording that were left out for one reason.

    Attributes:
        reason: ``jump``, ``bone length``, ``no body``, ``no person's size``, ``companion``,
            ``duplicate`` or ``too few frames``.
        file, person: whose. joint: empty for whole poses.
        frames: numbers as in the file; n_frames: how many.
        why: more about it, may be empty.
    """

    reason: str
    file: str
    person: str
    joint: str
    frames: str
    n_frames: int
    why: str = ""

    def text(self) -> str:
        """Return one line for the command line."""
        joint = f"{self.joint} in " if self.joint else ""
        why = f" ({self.why})" if self.why else ""
        return (
            f"{self.reason}: {self.file}, person {self.person}: {joint}"
            f"{counted(self.n_frames, 'frame')} {self.frames}{why}"
        )


class Size(NamedTuple):
    """Holds the number of persons, recordings and frames, and of measured joints among the eight."""

    persons: int
    recordings: int
    frames: int
    joints: int

    def text(self) -> str:
        """Return the counts in words."""
        return (
            f"{counted(self.recordings, 'recording')} of {counted(self.persons, 'person')}, "
            f"{counted(self.frames, 'frame')}, {counted(self.joints, 'joint')}"
        )


class CurationReport(NamedTuple):
    """Holds the counts before and after curation, and the omissions.

    Attributes:
        before, after: counts. drops: one per file, joint and reason. notes: what reading assumed and
            converted, with the number of recordings it concerns; what was changed on purpose.
        settings: the settings of the curation.
    """

    before: Size
    after: Size
    drops: tuple[Drop, ...]
    notes: tuple[str, ...]
    settings: dict[str, Any]

    def text(self, most: int = 20) -> str:
        """Return a few lines for the command line: totals, then the largest drops."""
        lines = [f"read     {self.before.text()}", f"kept     {self.after.text()}"]
        lines += [f"dropped  {text}: {reason}" for reason, text in self._counted().items()]
        largest = sorted(self.drops, key=lambda drop: -drop.n_frames)[:most]
        lines += [f"         {drop.text()}" for drop in largest]
        if len(self.drops) > most:
            lines.append(f"         and {len(self.drops) - most} more")
        lines += [f"note     {note}" for note in self.notes[:_SHOWN_NOTES]]
        if len(self.notes) > _SHOWN_NOTES:
            lines.append(f"note     and {len(self.notes) - _SHOWN_NOTES} more")
        return "\n".join(lines)

    def totals(self) -> dict[str, tuple[int, str]]:
        """Count the omissions by reason, with their unit (joints or frames)."""
        counts: Counter[tuple[str, str]] = Counter()
        for drop in self.drops:
            counts[drop.reason, "joints" if drop.joint else "frames"] += drop.n_frames
        return {reason: (n, what) for (reason, what), n in sorted(counts.items())}

    def _counted(self) -> dict[str, str]:
        """Return `totals` in words."""
        return {why: counted(n, what.removesuffix("s")) for why, (n, what) in self.totals().items()}

    def facts(self, most: int = 100) -> dict[str, Any]:
        """Return the report as plain values for JSON, with the largest drops."""
        largest = sorted(self.drops, key=lambda drop: -drop.n_frames)[:most]
        return {
            "before": self.before._asdict(),
            "after": self.after._asdict(),
            "dropped": self._counted(),
            "by_person": self._by_person(),
            "drops": [drop._asdict() for drop in largest],
            "drops_in_all": len(self.drops),
            "notes": list(self.notes),
            "settings": self.settings,
        }

    def for_prior(self) -> dict[str, Any]:
        """Return the facts for the file of a prior: counts, reasons and notes, without single drops."""
        shown = ("before", "after", "dropped", "by_person", "notes")
        facts = self.facts()
        return {"curation": {name: facts[name] for name in shown}}

    def _by_person(self) -> dict[str, dict[str, int]]:
        found: dict[str, dict[str, int]] = {}
        for drop in self.drops:
            reasons = found.setdefault(drop.person, {})
            reasons[drop.reason] = reasons.get(drop.reason, 0) + drop.n_frames
        return found


def drop_frames(
    reason: str,
    file: str,
    person: str,
    joint: str,
    frames: Iterable[int],
    first: int,
    why: str = "",
) -> Drop:
    """Return a `Drop` of these frames, counted from 0; `first` is the number of the first in the file."""
    listed = list(frames)
    return Drop(reason, file, person, joint, frame_ranges(listed, first), len(listed), why)
