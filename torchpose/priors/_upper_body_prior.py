"""Define the prior over the upper body: one Gaussian mixture per arm, and what it was fitted on."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchpose._core.checks import check_covariance, check_finite
from torchpose._core.module_state import NoHalfModule, register_given
from torchpose._core.reading import read_npz, reading
from torchpose._core.tensor_file import require_tensor
from torchpose.camera._pinhole import PinholeCamera
from torchpose.camera._projection import arm_in_body_frame, join_arms
from torchpose.errors import FileFormatError, InputError, OverlapError, PriorError, TorchposeError
from torchpose.priors._arm_state import (
    STATE_DIM,
    mirror_covariance,
    mirror_mixture,
)
from torchpose.priors._gaussian_mixture import GaussianMixture
from torchpose.priors._prior_file import PriorInfo, check_noise, read_prior, write_prior
from torchpose.priors._window import WindowPrior

WEIGHTS = Path(__file__).resolve().parents[1] / "weights"
_SIDES = ("left", "right")
_PARTS = ("weights", "means", "covariances")


class UpperBodyPrior(NoHalfModule):
    """Holds Gaussian mixtures over the states of the left and the right arm (BL 7, section 3.1).

    Args:
        left, right: mixtures over the 21 dimensions of an arm's state (`arm_states`).
        info: facts about the fit, and the conventions of the states.
        noise: learnt noise as named tensors, such as increment_cov_left and increment_cov_right
            (`increment_covs`, of which each method makes its Q), process_cov_left, process_cov_right
            (Q itself, of the Kalman filters), measurement_std, gamma or calibration. They become
            buffers and go into the file.
        windows: mixtures over short windows of motion by name ("causal", "full"; `WindowPrior`).

    Raises:
        PriorError: a mixture of another size.
        InputError: noise that is not finite, or a name that is no identifier.
    """

    left: GaussianMixture
    right: GaussianMixture

    def __init__(
        self,
        left: GaussianMixture,
        right: GaussianMixture,
        info: PriorInfo | None = None,
        noise: Mapping[str, Tensor] | None = None,
        windows: Mapping[str, WindowPrior] | None = None,
    ) -> None:
        super().__init__()
        for side, mixture in zip(_SIDES, (left, right), strict=True):
            if mixture.dim != STATE_DIM:
                raise PriorError(
                    f"the {side} mixture must be over the {STATE_DIM} dimensions of an arm's state, "
                    f"got {mixture.dim}"
                )
        self.left, self.right = left, right
        self.info = info or PriorInfo()
        self._noise_names: list[str] = []
        for name, value in (noise or {}).items():
            self.set_noise(name, value)
        self._windows = nn.ModuleDict(windows or {})

    @property
    def windows(self) -> dict[str, WindowPrior]:
        """Return mixtures over short windows of motion, by name."""
        return {name: cast(WindowPrior, window) for name, window in self._windows.items()}

    @property
    def noise(self) -> dict[str, Tensor]:
        """Return learnt noise by name."""
        return {name: getattr(self, f"noise_{name}") for name in self._noise_names}

    def set_noise(self, name: str, value: Tensor) -> None:
        """Store a tensor of learnt noise under a name.

        Args:
            name: an identifier, such as ``process_cov_left``.
            value: finite floating-point tensor.

        Raises:
            InputError: not a finite floating-point tensor, one that noise of this name cannot be, or
                the name is no identifier.
        """
        if not name.isidentifier():
            raise InputError(f"a name of noise must be an identifier, got {name!r}")
        if not isinstance(value, Tensor) or not value.is_floating_point():
            raise InputError(f"noise {name} must be a floating-point tensor, got {value!r:.60}")
        check_finite(f"noise {name}", value)
        check_noise(name, value)
        register_given(self, f"noise_{name}", value)
        if name not in self._noise_names:
            self._noise_names.append(name)

    @property
    def camera(self) -> PinholeCamera:
        """Return the camera whose pixels the states are in."""
        return self.info.camera

    @property
    def n_components(self) -> int:
        """Return the number of Gaussians of the left arm."""
        return self.left.n_components

    def mean_pose(self) -> Float[Tensor, "8 3"]:
        """Return the mean of the mixtures over poses in the body frame, metres: the least to be beaten."""
        order, matrix = self.info.rotation_order, self.info.matrix
        arms = []
        for arm in (self.left, self.right):
            joints, _ = arm_in_body_frame(arm.means, arm.covariances, matrix, order)
            arms.append((arm.weights[:, None, None] * joints).sum(0)[None, None])
        return join_arms(*arms)[0, 0]

    def mirrored(self) -> UpperBodyPrior:
        """Return the prior of the mirrored person: each arm is the mirror image of the other one.

        Noise by side changes sides; `info` and the rest stay.
        """
        noise = {_other_side(name): _mirrored_noise(v) for name, v in self.noise.items()}
        cx = self.info.cx
        windows = {name: window.mirrored(cx) for name, window in self.windows.items()}
        arms = mirror_mixture(self.right, cx), mirror_mixture(self.left, cx)
        return UpperBodyPrior(*arms, self.info, noise, windows)

    def check_unseen(self, persons: Collection[str]) -> None:
        """Check that the prior was fitted on none of some persons.

        Args:
            persons: ids, as `Recording.person_id`.

        Raises:
            OverlapError: it was fitted on one of them.
        """
        seen = sorted(set(persons) & set(self.info.persons))
        if seen:
            raise OverlapError(
                f"the prior {self.info.name!r} was fitted on {', '.join(seen)}; score it on other "
                "persons, or fit the same recipe without these; if they are others of the same name, rename "
                "their folders, or `subject` in their files"
            )

    def get_extra_state(self) -> Tensor:
        """Return `info` and the settings of the windows, as bytes of JSON [N], uint8."""
        return torch.tensor(list(self._full_info().to_json().encode()), dtype=torch.uint8)

    def set_extra_state(self, state: Tensor) -> None:
        """Take what `get_extra_state` returned, so that a loaded prior is not half of another.

        Raises:
            PriorError: windows of other names. FileFormatError: not such bytes.
        """
        text = bytes(state.tolist()).decode(errors="replace")
        info = PriorInfo.from_json(text)
        facts = info.extra.get("windows", {})
        if set(facts) != set(self.windows):
            raise PriorError(
                f"expected the state of a prior with the windows {sorted(self.windows)}, got one with "
                f"{sorted(facts)}; load it into a prior of the same kind"
            )
        self.info = info
        for name, window in self.windows.items():
            loaded = WindowPrior.from_facts(window.left, window.right, facts[name])
            window.layout, window.settings = loaded.layout, loaded.settings

    def _full_info(self) -> PriorInfo:
        facts = {name: window.facts() for name, window in self.windows.items()}
        return replace(self.info, extra=self.info.extra | ({"windows": facts} if facts else {}))

    def save(self, path: str | Path) -> None:
        """Write the prior as safetensors, atomically: an interrupted write leaves no partial file.

        Args:
            path: the file, which is replaced.

        Raises:
            OutputError: the file cannot be written. CovarianceError: a mixture that `load` would
                refuse.
        """
        for mixture in self.modules():
            if isinstance(mixture, GaussianMixture):
                check_covariance("covariances", mixture.covariances)
        tensors = {
            f"{side}.{part}": getattr(getattr(self, side), part)
            for side in _SIDES
            for part in _PARTS
        }
        tensors |= {f"noise.{name}": value for name, value in self.noise.items()}
        for name, window in self.windows.items():
            tensors |= {
                f"window.{name}.{side}.{part}": getattr(getattr(window, side), part)
                for side in _SIDES
                for part in _PARTS
            }
        write_prior(path, self._full_info(), tensors)

    @classmethod
    def load(cls, path: str | Path) -> UpperBodyPrior:
        """Read a prior that `save` wrote; tensors come back in float64.

        Args:
            path: safetensors file.

        Returns:
            The prior.

        Raises:
            InputError: no such file. FileFormatError: truncated, foreign, damaged, or of another
                version. PriorError: other skeleton, unknown rotation order.
        """
        info, tensors = read_prior(path)
        with reading(path, "a prior"):
            return cls._of_tensors(path, info, tensors)

    @classmethod
    def _of_tensors(
        cls, path: str | Path, info: PriorInfo, tensors: Mapping[str, Tensor]
    ) -> UpperBodyPrior:
        left, right = (_mixture(path, side, tensors) for side in _SIDES)
        noise = {
            key.removeprefix("noise."): value.to(torch.float64)
            for key, value in sorted(tensors.items())
            if key.startswith("noise.")
        }
        windows = {}
        for name, facts in info.extra.get("windows", {}).items():
            arms = [_mixture(path, f"window.{name}.{side}", tensors) for side in _SIDES]
            windows[name] = WindowPrior.from_facts(arms[0], arms[1], facts)
        return cls(left, right, info, noise, windows)

    @classmethod
    def from_released(cls, path: str | Path) -> UpperBodyPrior:
        """Read a prior that Burke & Lasenby released with their sign-language tracker.

        Its camera has f = 1550 and the centre (130, 105), its rotations are Rz Ry Rx, its poses
        are centred on the head, its neck is the middle of the shoulders (the tracker measures it 45
        pixels below the head). The noise is the tracker's Q.

        Args:
            path: .npz with {left,right}_{weights,means,covariances}.

        Returns:
            `UpperBodyPrior` in float64.

        Raises:
            InputError: no such file. FileFormatError: not such an archive.
        """
        keys = [f"{side}_{part}" for side in _SIDES for part in _PARTS]
        arrays = read_npz(path, keys)
        tensors = {
            f"{side}.{part}": torch.as_tensor(arrays[f"{side}_{part}"], dtype=torch.float64)
            for side in _SIDES
            for part in _PARTS
        }
        info = PriorInfo(
            name=Path(path).stem.removeprefix("released_prior_"),
            rotation_order="zyx",
            fx=1550.0, fy=1550.0, cx=130.0, cy=105.0,
            centre="head", neck="mid-shoulder", hand="hand", fps=25.0,
            sources=("https://github.com/mgb45/SignerBodyPose",), licence="MIT",
            extra={"neck_below_head_pixels": 45.0},
        )  # fmt: skip
        left, right = (_mixture(path, side, tensors) for side in _SIDES)
        noise = {f"process_cov_{side}": released_process_cov() for side in _SIDES}
        return cls(left, right, info, noise)


def released_process_cov() -> Tensor:
    """Return the diagonal [21] of Q in the authors' released sign-language tracker, pixels and metres."""
    return torch.tensor(
        [560, 560, 1, 56, 56, 1, *[25, 25, 1] * 3, 0.5, 0.5, 0.5, 0.01, 0.01, 0.01],
        dtype=torch.float64,
    )


def known_priors() -> list[str]:
    """Return the names of the priors that come with the package."""
    return sorted(p.stem for p in WEIGHTS.glob("*.safetensors"))


def load_prior(name_or_path: str | Path) -> UpperBodyPrior:
    """Load a prior that comes with the package, by its name, or one from a file.

    Args:
        name_or_path: a name (`known_priors`), or a .safetensors file.

    Returns:
        `UpperBodyPrior` in float64.

    Raises:
        PriorError: neither a known name nor a file. FileFormatError: a damaged or foreign file.
    """
    if not isinstance(name_or_path, str | Path):
        raise PriorError(
            f"expected the name of a prior or a .safetensors file, got {name_or_path!r:.60}"
        )
    shipped = WEIGHTS / f"{name_or_path}.safetensors"
    if str(name_or_path) in known_priors():
        return UpperBodyPrior.load(shipped)
    if os.path.isfile(name_or_path):
        return UpperBodyPrior.load(name_or_path)
    names = ", ".join(known_priors()) or "none in this installation"
    raise PriorError(
        f"expected the name of a prior ({names}) or a .safetensors file, got {str(name_or_path)!r}, "
        "which is neither"
    )


def _mixture(path: str | Path, side: str, tensors: Mapping[str, Tensor]) -> GaussianMixture:
    parts = [require_tensor(path, tensors, f"{side}.{part}") for part in _PARTS]
    try:
        return GaussianMixture(*parts)
    except TorchposeError as error:
        raise FileFormatError(f"{path}: the {side} mixture is damaged: {error}") from error


def _mirrored_noise(value: Tensor) -> Tensor:
    """Return the noise of the mirror image: a covariance of states changes signs, variances do not."""
    return mirror_covariance(value) if value.shape == (STATE_DIM, STATE_DIM) else value


def _other_side(name: str) -> str:
    for here, there in (_SIDES, _SIDES[::-1]):
        if name.endswith(f"_{here}"):
            return f"{name.removesuffix(here)}{there}"
    return name
