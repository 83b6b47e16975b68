"""Write the table of all recordings of a batch, with the outcome of each."""

import csv
import io
import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torchpose._core.files import atomic_path
from torchpose._core.wording import alike_once, counted
from torchpose.errors import OutputError

__all__ = [
    "COLUMNS",
    "OTHER",
    "Outcome",
    "check_summary",
    "count_outcomes",
    "name_notes",
    "name_others",
    "write_summary",
]

COLUMNS = ("recording", "state", "frames", "fps", "seconds", "log_evidence",
           "log_evidence_per_frame", "missing", "failed_at", "took_seconds", "error")  # fmt: skip
OTHER = "no recording"
_SHOWN = 5  # of what failed, and of files that are no recordings
_WORDS = {"made": "made", "found": "made before or by others", "failed": "failed"}


class Outcome(NamedTuple):
    """The outcome of tracking a recording.

    Attributes:
        recording: its name; of a file that is none its path.
        state: "made" now, "found" from before, "failed", or "no recording".
        facts: of its result, see `train.predict_tracking.facts_of`. error: why there is none.
    """

    recording: str
    state: str
    facts: Mapping[str, Any] | None = None
    error: str = ""

    @property
    def good(self) -> bool:
        """Return whether there are poses for all frames."""
        return self.facts is not None and self.facts["failed_at"] < 0

    def row(self) -> dict[str, Any]:
        """Return its line in the summary, the same whichever process writes it."""
        if self.facts is None:
            return {"recording": self.recording, "state": self.state, "error": self.error}
        facts = dict(self.facts)
        facts["log_evidence_per_frame"] = facts["log_evidence"] / facts["frames"]
        numbers = {key: _text(facts[key]) for key in COLUMNS if key in facts}
        state = "done" if self.good else "degenerate"
        return numbers | {"recording": self.recording, "state": state, "error": self.error}


def check_summary(path: Path) -> None:
    """Raise if there is another table in the place of the summary.

    Raises:
        OutputError: there is.
    """
    if not os.path.lexists(path):
        return
    header = b""
    if path.is_file():
        with path.open("rb") as stream:
            header = stream.readline().strip()
    if header != ",".join(COLUMNS).encode():
        raise OutputError(
            f"{path}: is there already, but was not written by this command; move it or choose another "
            "--out"
        )


def write_summary(path: Path, outcomes: Mapping[str, Outcome]) -> None:
    """Write a row for every recording, by name, unless the same table is there already.

    Every process that gets to the end does this, so that it does not matter which one is the last.

    Raises:
        OutputError: the file cannot be written.
    """
    table = io.StringIO()
    writer = csv.DictWriter(table, COLUMNS, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(outcomes[name].row() for name in sorted(outcomes))
    if path.is_file() and path.read_text(encoding="utf-8") == table.getvalue():
        return
    with atomic_path(path) as temporary:
        temporary.write_text(table.getvalue(), encoding="utf-8")


def count_outcomes(outcomes: Mapping[str, Outcome]) -> str:
    """Say how many recordings were tracked, found and failed."""
    states = Counter(outcome.state for outcome in outcomes.values())
    parts = [f"{states[state]} {word}" for state, word in _WORDS.items() if states[state]]
    broken = sum(o.facts is not None and not o.good for o in outcomes.values())
    if broken:
        parts.append(f"in {broken} the filter degenerated (failed_at in the summary)")
    return f"{counted(len(outcomes) - states[OTHER], 'recording')}: {', '.join(parts)}"


def name_others(outcomes: Mapping[str, Outcome]) -> list[str]:
    """Say which recordings failed and which files are none, the first few of each, and why."""
    return [line for state in ("failed", OTHER) for line in _named(outcomes, state)]


def name_notes(outcomes: Mapping[str, Outcome]) -> list[str]:
    """Say what was assumed of recordings and is doubtful about them, the most frequent first."""
    notes = [note for o in outcomes.values() if o.facts for note in o.facts.get("notes", ())]
    return alike_once(notes)[:_SHOWN]


def _named(outcomes: Mapping[str, Outcome], state: str) -> list[str]:
    found = [outcomes[name] for name in sorted(outcomes) if outcomes[name].state == state]
    lines = [f"{state}: {one.recording}: {one.error}" for one in found[:_SHOWN]]
    if len(found) > _SHOWN:
        lines.append(f"{state}: {len(found) - _SHOWN} more, which the summary lists")
    return lines


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
