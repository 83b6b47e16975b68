"""The files of a fit to whole bodies: the model, its card and its picture, and what to say of them."""

from pathlib import Path

from torchpose.io.results import ResultsFolder
from torchpose.learning.body_card import write_body_card
from torchpose.learning.recipes.actions import FittedActions
from torchpose.learning.recipes.limbs import LimbStates, fit_limbs, summary
from torchpose.learning.recipes.manifold import ManifoldFitting

__all__ = ["write_action_files", "write_limb_files", "write_manifold_files"]


def write_manifold_files(
    fitting: ManifoldFitting, results: ResultsFolder, file: str, picture: bool = False, **facts: str
) -> str:
    """Write a fitted manifold, its card (.md) and its latent space (.png); returns what was done.

    Args:
        fitting: at its end. results: where the files go. file: name of the manifold's.
        picture: draw the latent space, which needs matplotlib. facts: name, licence, command.
    """
    manifold, out = fitting.manifold(**facts), results.stage / file
    manifold.save(out)
    written = [out, write_body_card(manifold, out.with_suffix(".md"))]
    if picture:
        from torchpose.viz.manifold_picture import plot_manifold
        from torchpose.viz.style import save_figure

        figure = plot_manifold(manifold, {"held out": list(fitting.data.watched)[:1]})
        written.append(save_figure(figure, out.with_suffix(".png")))
    return f"{fitting.summary(manifold)}\n{_committed(results, written)}"


def write_limb_files(
    states: LimbStates, results: ResultsFolder, file: str, least_std: float = 0.01, **facts: str
) -> str:  # fmt: skip
    """Fit limb conditionals, and write them and their card (.md); returns what was done.

    Args:
        states: to fit to. results: where the files go. file: name of the conditionals'.
        least_std: see `fit_limbs`. facts: name, licence, command.
    """
    found, held_out = fit_limbs(states, least_std, **facts)
    out = results.stage / file
    found.save(out)
    written = [out, write_body_card(found, out.with_suffix(".md"))]
    return f"{summary(found, held_out)}\n{_committed(results, written)}"


def write_action_files(
    fitted: FittedActions, results: ResultsFolder, file: str, picture: bool = False, **facts: str
) -> str:
    """Write an action space or a bank, its card (.md) and a picture (.png) of each action.

    Args:
        fitted: to be written. results: where the files go. file: name of the space's or bank's.
        picture: draw the synchronised performances, which needs
            matplotlib. facts: name, licence, command.

    Returns:
        What was done.
    """
    found, out = fitted.result(**facts), results.stage / file
    found.save(out)
    written = [out, write_body_card(found, out.with_suffix(".md"), facts.get("name", ""))]
    if picture:
        from torchpose.viz.action_picture import plot_action_space
        from torchpose.viz.style import save_figure

        several = len(fitted.spaces) > 1
        for action, (space, steps) in fitted.spaces.items():
            path = out.with_name(f"{out.stem}-{action}.png" if several else f"{out.stem}.png")
            written.append(save_figure(plot_action_space(space, steps), path))
    return f"{fitted.summary()}\n{_committed(results, written)}"


def _committed(results: ResultsFolder, written: list[Path]) -> str:
    places = results.commit(written)
    return "\n".join([f"wrote {', '.join(map(str, places))}", *results.notes])
