"""Write the files of a fit: the model, its card (.md) and pictures of it (.png), all by `write_fit`."""

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from torchpose._core.tensor_file import format_of
from torchpose._core.wording import first_of
from torchpose.errors import OutputError
from torchpose.io._results import ResultsFolder
from torchpose.learning._model_card import MODES, BodyModel, body_card, model_card
from torchpose.learning._recipes.actions import FittedActions
from torchpose.learning._recipes.manifold import ManifoldFitting
from torchpose.priors._upper_body_prior import UpperBodyPrior

_SHOWN = 3  # persons
_NO_NAME = re.compile(r'[/\\:*?"<>|\x00-\x1f]')  # not in names of files, at least on Windows


def check_fit_file(name: str | Path) -> Path:
    """Return the path of the file that a fit is to write.

    Raises:
        OutputError: another suffix than .safetensors, or a folder.
    """
    out = Path(name)
    if out.suffix != ".safetensors":
        raise OutputError(f"{out}: expected a name that ends in .safetensors")
    if out.is_dir():
        raise OutputError(f"{out}: is a folder; give the name of a file")
    return out


def fit_results(out: Path, inputs: Iterable[str | Path], pictures: bool) -> ResultsFolder:
    """Return the results folder of a fit: its file, and those of the same name beside it.

    Args:
        out: the file, NAME.safetensors. inputs: files that are read. pictures: whether some are drawn.
    """
    beside = (".md", ".png") if pictures else (".md",)
    return ResultsFolder(
        out.parent,
        f"fit-{out.stem}",
        rf"{re.escape(out.stem)}(\.(safetensors|md|png)|-.+\.png)",
        [out.name, *(out.with_suffix(suffix).name for suffix in beside)],
        inputs,
        lambda _: out.is_file() and (format_of(out) or "").startswith("torchpose"),
    )


def write_fit(
    model: UpperBodyPrior | BodyModel,
    card: str,
    results: ResultsFolder,
    file: str,
    pictures: Mapping[str, Callable[[], Any]] | None = None,
) -> list[Path]:
    """Write a model and its card, then pictures of it, and return where they are.

    The pictures only show the model, so that it is kept where one cannot be drawn.

    Args:
        model: that was fitted. card: Markdown text on it. results: folder of the files.
        file: name of the model's. pictures: what draws each, by the name of its file; they need
            matplotlib.
    """
    out = results.stage / file
    model.save(out)
    out.with_suffix(".md").write_text(card, encoding="utf-8")
    written = results.commit([out, out.with_suffix(".md")])
    if pictures:
        from torchpose.viz._style import save_figure

        drawn = [save_figure(draw(), results.stage / name) for name, draw in pictures.items()]
        written += results.commit(drawn)
    return written


# --- what each kind of fit writes, and says -------------------------------------------------------


def write_prior_files(
    prior: UpperBodyPrior, results: ResultsFolder, file: str, picture: bool
) -> str:
    """Write a prior of the upper body, its card and a picture of its mean poses; return a report.

    Args:
        prior: that was fitted. results: folder of the files. file: name of the prior's.
        picture: draw the mean poses, which needs matplotlib.
    """

    def draw() -> Any:
        from torchpose import viz

        return viz.plot_prior_means({"left arm": prior.left, "right arm": prior.right})

    pictures = {f"{Path(file).stem}.png": draw} if picture else None
    written = write_fit(prior, model_card(prior), results, file, pictures)
    lines = [*_prior_lines(prior), *(f"note     {note}" for note in results.notes)]
    return "\n".join([*lines, *(f"wrote    {path}" for path in written)])


def write_body_model(
    model: BodyModel,
    summary: str,
    results: ResultsFolder,
    file: str,
    pictures: Mapping[str, Callable[[], Any]] | None = None,
) -> str:
    """Write a model for body trackers, its card and pictures of it; return a report.

    Args:
        model: that was fitted. summary: of the fit, which the report begins with.
        results, file, pictures: see `write_fit`.
    """
    written = write_fit(model, body_card(model, file=file), results, file, pictures)
    return "\n".join([summary, f"wrote {', '.join(map(str, written))}", *results.notes])


def write_manifold_files(
    fitting: ManifoldFitting, results: ResultsFolder, file: str, picture: bool = False, **facts: str
) -> str:
    """Write a fitted manifold, its card and its latent space; return a report.

    Args:
        fitting: at its end. results: folder of the files. file: name of the manifold's.
        picture: draw the latent space, which needs matplotlib. facts: name, licence, command.
    """
    manifold = fitting.manifold(**facts)

    def draw() -> Any:
        from torchpose.viz._model_pictures import plot_manifold

        return plot_manifold(manifold, {"held out": list(fitting.data.watched)[:1]})

    drawable = manifold.latent_dim > 1
    pictures = {f"{Path(file).stem}.png": draw} if picture and drawable else None
    written = write_body_model(manifold, fitting.summary(manifold), results, file, pictures)
    if picture and not drawable:
        written = f"{written}\nnote: there is no picture of one latent dimension"
    return written


def write_action_files(
    fitted: FittedActions, results: ResultsFolder, file: str, picture: bool = False, **facts: str
) -> str:
    """Write an action space or a bank, its card and a picture of each action; return a report.

    Args:
        fitted: to be written. results: folder of the files. file: name of the space's or bank's.
        picture: draw the synchronised performances, which needs
            matplotlib. facts: name, licence, command.
    """
    stem, several = Path(file).stem, len(fitted.spaces) > 1

    def drawing(action: str) -> Callable[[], Any]:
        from torchpose.viz._model_pictures import plot_action_space

        return lambda: plot_action_space(*fitted.spaces[action])

    names = {
        f"{stem}-{_NO_NAME.sub('_', a)}.png" if several else f"{stem}.png": a for a in fitted.spaces
    }
    pictures = {name: drawing(action) for name, action in names.items()} if picture else None
    return write_body_model(fitted.result(**facts), fitted.summary(), results, file, pictures)


def _prior_lines(prior: UpperBodyPrior) -> list[str]:
    """Return a summary of the fit: the data, the size, and the expected errors, a line each."""
    info = prior.info
    windows = [w.left.n_components for w in prior.windows.values()]
    over = f" and {max(windows)} over windows" if windows else ""
    lines = [
        f"prior    {info.name}, {prior.n_components} components per arm{over}, neck: {info.neck}, "
        f"hand: {info.hand}",
        f"persons  {len(info.persons)}, named in the file and its card: {first_of(info.persons, _SHOWN)}",
        f"states   {info.n_samples} per arm from {info.n_frames} recorded frames",
    ]
    fit = info.extra.get("fit")
    if fit:
        end = "" if fit["converged"] else ", not converged"
        lines.append(
            f"EM       mean log-likelihood {fit['log_likelihood']:.4f} after {fit['iterations']} "
            f"iterations{end}"
        )
    lines.append(f"noise    {', '.join(prior.noise) or 'not learnt'}")
    return lines + [f"expect   {line}" for line in _expected(info.extra)]


def _expected(extra: Mapping[str, Any]) -> list[str]:
    """Return the expected errors of an unseen person, from those of the persons that were held out."""
    held_out, still = extra.get("held_out", {}), extra.get("held_out_still", {})
    lines = []
    for mode in [mode for mode in ("causal", "full") if held_out.get(mode)] or held_out:
        errors = [100 * error for error in held_out[mode].values()]
        spread = f" +- {stdev(errors):.1f}" if len(errors) > 1 else ""
        lines.append(f"{fmean(errors):.1f}{spread} cm {MODES[mode]} on somebody new")
    if still:
        lines.append(f"{100 * fmean(still.values()):.1f} cm of the mean pose, without looking")
    return lines
