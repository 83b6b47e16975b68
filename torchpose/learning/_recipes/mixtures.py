"""One mixture of a recipe, and what it is fitted to."""

from typing import NamedTuple

from torchpose.learning._samplers import SampleSource, cached
from torchpose.learning._streamed_em import ColumnsSource, complete_mixture, fit_streamed
from torchpose.priors._gaussian_mixture import GaussianMixture

__all__ = ["MixtureTask"]


class MixtureTask(NamedTuple):
    """One mixture to be fitted.

    Attributes:
        source: of its training states. n_components: K. max_iter, tol: of the steps of EM; a
            tolerance of 0 takes all of them. seed: of the start.
    """

    source: SampleSource
    n_components: int
    max_iter: int
    tol: float
    seed: int

    def fit(self) -> GaussianMixture:
        """The whole mixture, fitted in this process."""
        source = cached(self.source)
        fitted = fit_streamed(
            source, self.n_components, self.seed, max_iter=self.max_iter, tol=self.tol
        )
        return self.whole(fitted)

    def whole(self, mixture: GaussianMixture) -> GaussianMixture:
        """The mixture over all dimensions of its states, if it was fitted to some of them only."""
        source = self.source
        if not isinstance(source, ColumnsSource) or mixture.dim == source.source.dim:
            return mixture
        return complete_mixture(mixture, source.source, source.columns)
