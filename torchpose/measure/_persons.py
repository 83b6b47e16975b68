"""Number the persons of a video, and recognise those who return."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from torchpose._core.images import Image
from torchpose.errors import InputError

State = TypeVar("State", bound=tuple[Any, ...])
_BINS = 8
_CLOTHES = (0.8, 1.3, 2.6)  # half the width, top and bottom below the face, in its sizes
_LEARNING = 0.05
_CLEARLY = 1.2  # times as large as somebody who is followed, from which another one takes the place


class Persons(NamedTuple):
    """Holds the P persons who may come back, in the order of their numbers.

    Attributes:
        number: of each [P]. face: identity of the face that each had last [P].
        colours: of their clothes [P, 512]. last_seen: frame [P].
        n_ever: how many persons there were, those who cannot be recognised any more included.
    """

    number: Int[Tensor, " P"]
    face: Int[Tensor, " P"]
    colours: Float[Tensor, "P 512"]
    last_seen: Int[Tensor, " P"]
    n_ever: int

    def face_of(self, number: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
        """Return the identity of the face that each of these persons had last."""
        return self.face[match_rows(self.number, number)]


def match_rows(known: Int[Tensor, " K"], wanted: Int[Tensor, " N"]) -> Int[Tensor, " N"]:
    """Return the row of each wanted person among the known ones, K for a new person.

    >>> match_rows(torch.tensor([7, 4]), torch.tensor([4, 9])).tolist()
    [1, 2]
    """
    same = torch.nn.functional.pad(wanted[:, None] == known, (0, 1), value=True)
    return same.int().argmax(1)  # the first that is the same, or the one behind all


def match_states(state: State, fresh: State, identity: Int[Tensor, " N"]) -> State:
    """Return the rows of a state in the order of `identity`, a fresh row for each new person.

    Args:
        state: with a field `identity`; every tensor has the persons as its first dimension.
        fresh: the state of one newcomer.
    """
    known: Any = state
    identity = identity.to(known.identity)
    rows = match_rows(known.identity, identity)
    matched: Any = _map(lambda old, new: torch.cat([old, new])[rows], state, fresh)
    return matched._replace(identity=identity.clone())  # type: ignore[no-any-return]


def largest_persons(
    number: Int[Tensor, " N"], size: Float[Tensor, " N"], before: Int[Tensor, " n"], most: int
) -> Int[Tensor, " M"]:
    """Return the rows of the largest persons; who was followed before gives way to a clearly larger one.

    Args:
        number, size: of all who are present. before: numbers of those followed so far. most: M, at most.

    >>> number, size = torch.tensor([0, 1, 2]), torch.tensor([30.0, 33.0, 40.0])
    >>> largest_persons(number, size, torch.tensor([0]), 2).tolist()
    [0, 2]
    """
    worth = torch.where(torch.isin(number, before), _CLEARLY * size, size)
    return worth.argsort(descending=True, stable=True)[:most].sort().values


def take_rows(state: State, rows: slice | Tensor) -> State:
    """Return some persons of a state; every tensor has the persons as its first dimension."""
    return _map(lambda tensor: tensor[rows], state)


def measure_by_scale(scales: Tensor, measure: Callable[[float, Int[Tensor, " n"]], State]) -> State:
    """Measure the persons of each scale together, and return all of them in their own order.

    Args:
        scales: of the persons [N].
        measure: is called with a scale and the rows of its persons; with no persons, once.
    """
    values, group = scales.unique(return_inverse=True)
    rows = [torch.nonzero(group == k).flatten() for k in range(len(values))]
    if not rows:
        rows, values = [group], scales.new_ones(1)
    found = [measure(value, own) for value, own in zip(values.tolist(), rows, strict=True)]
    order = torch.cat(rows).argsort()
    return _map(lambda *parts: torch.cat(parts)[order], *found)


def _map(function: Callable[..., Tensor], *states: Any) -> Any:
    """Return the state whose tensors are those of a function of the states' tensors."""
    if isinstance(states[0], Tensor):
        return function(*states)
    fields = (_map(function, *values) for values in zip(*states, strict=True))
    return type(states[0])(*fields)


def clothes_colours(image: Image, faces: Float[Tensor, "N 3"]) -> Float[Tensor, "N 512"]:
    """Return the histogram of the colours below each face, 8 x 8 x 8 bins of RGB; zero without pixels."""
    found = [_histogram(image, face) for face in faces.tolist()]
    return torch.from_numpy(np.stack(found)) if found else torch.zeros(0, _BINS**3).double()


def _histogram(image: Image, face: list[float]) -> np.ndarray:
    x, y, size = face
    rows, columns = image.shape[:2]
    half, top, bottom = (share * size for share in _CLOTHES)
    left, right = int(max(0, x - half)), int(min(columns, x + half))
    above, below = int(max(0, y + top)), int(min(rows, y + bottom))
    part = image[above : max(0, below), max(0, left) : max(0, right)]
    step = max(1, int(size / 20))
    bins = (part[::step, ::step].reshape(-1, 3) >> 5).astype(np.int64)
    counts = np.bincount(bins @ np.array([64, 8, 1]), minlength=_BINS**3).astype(np.float64)
    return np.asarray(counts / max(counts.sum(), 1.0))


class PersonRegister(nn.Module):
    """Assigns numbers to persons in the order of their appearance, and recognises them by their clothes.

    A new face is associated with a person who left within `within` frames if the histograms of their
    clothes are similar, sum_k sqrt(p_k q_k) >= `likeness` (Bhattacharyya).

    Args:
        within: frames. likeness: in (0, 1].

    Raises:
        InputError: settings out of range.
    """

    def __init__(self, within: int = 900, likeness: float = 0.75) -> None:
        super().__init__()
        if within < 0 or not 0 < likeness <= 1:
            raise InputError(
                f"within must be at least 0 frames and likeness in (0, 1], got {within}, {likeness}"
            )
        self.within, self.likeness = within, likeness

    def init(self) -> Persons:
        """Return the state without persons."""
        nobody = torch.zeros(0, dtype=torch.long)
        colours = torch.zeros(0, _BINS**3, dtype=torch.float64)
        return Persons(nobody, nobody.clone(), colours, nobody.clone(), 0)

    def recognises(
        self,
        persons: Persons,
        image: Image,
        faces: Float[Tensor, "N 3"],
        identity: Int[Tensor, " N"],
    ) -> Bool[Tensor, " N"]:
        """Return whether the clothes below faces are those of their persons, or cannot be seen.

        A face whose person has got another one is not recognised.

        Args:
            image: RGB. faces: (x, y, size), pixels. identity: of the faces.
        """
        colours = clothes_colours(image, faces)
        owner = match_rows(persons.face, identity)
        known = torch.nn.functional.pad(persons.colours, (0, 0, 0, 1))[owner]
        unseen = (colours.sum(1) == 0) | (known.sum(1) == 0)
        alike = unseen | ((known * colours).sqrt().sum(1) >= self.likeness)
        return alike & (owner < len(persons.face))

    def step(
        self,
        persons: Persons,
        image: Image,
        faces: Float[Tensor, "N 3"],
        identity: Int[Tensor, " N"],
        frame: int,
        detected: Bool[Tensor, " N"] | None = None,
        lost: Bool[Tensor, " N"] | None = None,
    ) -> tuple[Persons, Int[Tensor, " N"]]:
        """Return the next state, and the number of the person of each face.

        A newcomer may be a person in the same clothes whose face is lost. Then two faces have that number,
        and the newcomer's is the one in `Persons.face`. Who cannot be recognised any more is forgotten.

        Args:
            image: RGB. faces: (x, y, size), pixels. identity: of the tracked faces. frame: number.
            detected: False where a face has not been detected lately and its place is predicted: the
                clothes below it are not learnt. None means all are detected.
            lost: True where a face may be found elsewhere, as that of a newcomer. None means nowhere.
        """
        persons = self._without_long_gone(persons, identity, frame)
        colours = clothes_colours(image, faces)
        owner = match_rows(persons.face, identity)
        owner = torch.where(owner < len(persons.face), owner, -1)
        for row in torch.nonzero(owner < 0).flatten().tolist():  # newcomers, seldom any
            followed = owner[owner >= 0 if lost is None else (owner >= 0) & ~lost]
            persons, owner[row] = self._admit(persons, colours[row], identity[row], followed, frame)
        known = persons.colours.clone()
        rate = _LEARNING if detected is None else _LEARNING * detected.to(colours)[:, None]
        known[owner] += rate * (colours - known[owner])
        last_seen = persons.last_seen.clone()
        last_seen[owner] = frame
        return persons._replace(colours=known, last_seen=last_seen), persons.number[owner]

    def _without_long_gone(self, persons: Persons, identity: Tensor, frame: int) -> Persons:
        """Return the state without persons who left too long ago to be recognised."""
        gone = frame - persons.last_seen > self.within
        if not bool(gone.any()):
            return persons
        kept = ~gone | torch.isin(persons.face, identity)
        number, face, colours, last_seen, n_ever = persons
        return Persons(number[kept], face[kept], colours[kept], last_seen[kept], n_ever)

    def _admit(
        self, persons: Persons, colours: Tensor, identity: Tensor, followed: Tensor, frame: int
    ) -> tuple[Persons, int]:
        """Return the next state and the row of a newcomer, who is none of those `followed` already.

        Args:
            colours: of the newcomer's clothes. identity: of the face. followed: rows of persons.
        """
        alike = (persons.colours * colours).sqrt().sum(1)
        away = frame - persons.last_seen <= self.within
        away[followed] = False
        alike = torch.where(away & (alike >= self.likeness), alike, -torch.ones_like(alike))
        if len(alike) and float(alike.max()) > 0:
            row = int(alike.argmax())
            face = persons.face.clone()
            face[row] = identity
            return persons._replace(face=face), row
        number, face, known, last_seen, n_ever = persons
        joined = Persons(
            torch.cat([number, number.new_tensor([n_ever])]), torch.cat([face, identity[None]]),
            torch.cat([known, colours[None]]), torch.cat([last_seen, last_seen.new_tensor([frame])]),
            n_ever + 1,
        )  # fmt: skip
        return joined, len(face)
