"""Load models that come with the package, by their names: manifolds, limb conditionals, actions, bodies."""

from __future__ import annotations

from pathlib import Path

from torchpose._core.tensor_file import format_of
from torchpose.errors import PriorError
from torchpose.priors._actions.bank import ActionBank
from torchpose.priors._actions.space import ActionSpace
from torchpose.priors._body_motion import BodyMotion
from torchpose.priors._limb_conditionals import LimbConditionals
from torchpose.priors._manifold.gplvm import BackConstrainedGPLVM

WEIGHTS = Path(__file__).parent.parent / "weights"

KINDS = {
    "manifolds": "a manifold",
    "conditionals": "limb conditionals",
    "actions": "an action space or bank",
    "bodies": "a prior over the motion of bodies",
}
"""Kinds of models, as their folders are called, and in words."""


def known_models(kind: str) -> list[str]:
    """Return the names of the models of a kind that come with the package.

    Args:
        kind: "manifolds", "conditionals", "actions", "bodies" or another folder of models.

    Returns:
        Names in alphabetical order; none for an unknown kind.
    """
    return sorted(path.stem for path in (WEIGHTS / kind).glob("*.safetensors"))


def find_model(kind: str, name_or_path: str | Path) -> Path:
    """Return the file of a model that comes with the package, by its name, or the file of this path.

    Args:
        kind: among `KINDS`. name_or_path: a name (`known_models`), or a file.

    Raises:
        PriorError: neither a known name nor a file.
    """
    if not isinstance(name_or_path, str | Path):
        raise PriorError(
            f"{KINDS[kind]} is loaded by its name or file, got {type(name_or_path).__name__}"
        )
    if str(name_or_path) in known_models(kind):
        return WEIGHTS / kind / f"{name_or_path}.safetensors"
    if Path(name_or_path).is_file():
        return Path(name_or_path)
    names = ", ".join(known_models(kind)) or "none in this installation"
    raise PriorError(
        f"{name_or_path}: no such file, and no such model of this package; expected the name of "
        f"{KINDS[kind]} ({names}), or a .safetensors file"
    )


def load_manifold(name_or_path: str | Path) -> BackConstrainedGPLVM:
    """Load a manifold of poses that comes with the package, by its name, or one from a file.

    Args:
        name_or_path: a name (``known_models("manifolds")``), or a file of `torchpose fit manifold`.

    Returns:
        `BackConstrainedGPLVM`.

    Raises:
        PriorError: neither a known name nor a file. FileFormatError: a damaged or foreign file.

    >>> manifold = load_manifold("walk")
    >>> manifold.info.actions, manifold.info.fps
    (('walk',), 60.0)
    """
    return BackConstrainedGPLVM.load(find_model("manifolds", name_or_path))


def load_limb_conditionals(name_or_path: str | Path) -> LimbConditionals:
    """Load limb conditionals that come with the package, by their name, or some from a file.

    Args:
        name_or_path: a name (``known_models("conditionals")``), or a file of `torchpose fit limbs`.

    Returns:
        `LimbConditionals`.

    Raises:
        PriorError: neither a known name nor a file. FileFormatError: a damaged or foreign file.

    >>> load_limb_conditionals("walk").info.fps
    60.0
    """
    return LimbConditionals.load(find_model("conditionals", name_or_path))


def load_action(name_or_path: str | Path) -> ActionSpace | ActionBank:
    """Load an action space or bank that comes with the package, by its name, or one from a file.

    Args:
        name_or_path: a name (``known_models("actions")``), or a file of `torchpose fit actions`.

    Returns:
        `ActionSpace` of one action, or `ActionBank` of several.

    Raises:
        PriorError: neither a known name nor a file. FileFormatError: a damaged or foreign file.

    >>> load_action("exercises").names[:2]
    ('bend', 'jumping_jacks')
    """
    path = find_model("actions", name_or_path)
    bank = format_of(path) == "torchpose-action-bank"
    return ActionBank.load(path) if bank else ActionSpace.load(path)


def load_body_motion(name_or_path: str | Path) -> BodyMotion:
    """Load a prior over the motion of bodies that comes with the package, by its name, or one from a file.

    Args:
        name_or_path: a name (``known_models("bodies")``), or a file of `torchpose fit body`.

    Returns:
        `BodyMotion` in float64.

    Raises:
        PriorError: neither a known name nor a file. FileFormatError: a damaged or foreign file.

    >>> load_body_motion("whole-body").info.fps
    30.0
    """
    return BodyMotion.load(find_model("bodies", name_or_path))
