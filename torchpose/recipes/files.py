"""The files of a fit to whole bodies: the model, its card and its picture, and what to say of them."""

from pathlib import Path

from torchpose.priors.body_card import write_body_card
from torchpose.recipes.actions import FittedActions
from torchpose.recipes.limbs import LimbStates, fit_limbs, summary
from torchpose.recipes.manifold import ManifoldFitting

__all__ = ["write_action_files", "write_limb_files", "write_manifold_files"]


def write_manifold_files(
    fitting: ManifoldFitting, out: Path, picture: bool = False, **facts: str
) -> str:
    """Write a fitted manifold, its card (.md) and its latent space (.png); returns what was done.

    Args:
        fitting: at its end. out: the file. picture: draw the latent space, which needs matplotlib.
        facts: name, licence, command.
    """
    manifold = fitting.manifold(**facts)
    manifold.save(out)
    written = [out, write_body_card(manifold, out.with_suffix(".md"))]
    if picture:
        from torchpose.viz import save_figure
        from torchpose.viz.manifold_picture import plot_manifold

        figure = plot_manifold(manifold, {"held out": list(fitting.data.watched)[:1]})
        written.append(save_figure(figure, out.with_suffix(".png")))
    return f"{fitting.summary(manifold)}\n{_listed(written)}"


def write_limb_files(
    states: LimbStates, out: Path, least_std: float = 0.01, **facts: str
) -> str:  # fmt: skip
    """Fit limb conditionals, and write them and their card (.md); returns what was done.

    Args:
        states: to fit to. out: the file. least_std: see `fit_limbs`. facts: name, licence, command.
    """
    found, held_out = fit_limbs(states, least_std, **facts)
    found.save(out)
    written = [out, write_body_card(found, out.with_suffix(".md"))]
    return f"{summary(found, held_out)}\n{_listed(written)}"


def write_action_files(
    fitted: FittedActions, out: Path, picture: bool = False, **facts: str
) -> str:
    """Write an action space or a bank, its card (.md) and a picture (.png) of each action.

    Args:
        fitted: to be written. out: the file. picture: draw the synchronised performances, which needs
            matplotlib. facts: name, licence, command.

    Returns:
        What was done.
    """
    found = fitted.result(**facts)
    found.save(out)
    written = [out, write_body_card(found, out.with_suffix(".md"), facts.get("name", ""))]
    if picture:
        from torchpose.viz import save_figure
        from torchpose.viz.action_picture import plot_action_space

        several = len(fitted.spaces) > 1
        for action, (space, steps) in fitted.spaces.items():
            path = out.with_name(f"{out.stem}-{action}.png" if several else f"{out.stem}.png")
            written.append(save_figure(plot_action_space(space, steps), path))
    return f"{fitted.summary()}\n{_listed(written)}"


def _listed(written: list[Path]) -> str:
    return f"wrote {', '.join(map(str, written))}"
