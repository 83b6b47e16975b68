"""Build the layers of the hand network, and fold their normalisation away where nothing is learnt."""

from copy import deepcopy
from typing import NamedTuple, TypeVar, cast
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import conv2d, conv_transpose2d, interpolate

from torchpose._core.module_state import outside_inference

Network = TypeVar("Network", bound=nn.Module)


class Layer(nn.Sequential):
    """Applies a convolution, the normalisation of batches, and a rectifier.

    Args:
        before, after: channels. size: of the kernel. stride: cells to one. apart: dilation of the kernel.
    """

    def __init__(
        self, before: int, after: int, size: int = 3, stride: int = 1, apart: int = 1
    ) -> None:
        padding = apart * (size // 2)
        super().__init__(
            nn.Conv2d(before, after, size, stride, padding, dilation=apart, bias=False),
            nn.BatchNorm2d(after),
            nn.ReLU(inplace=True),
        )

    @property
    def convolution(self) -> nn.Conv2d:
        """Return the convolution."""
        return cast(nn.Conv2d, self[0])


class UpwardLayer(Layer):
    """Applies a layer to maps of cells twice as wide, and to maps of these cells.

    Args:
        coarse, fine: channels of the two. after: channels of the result.
    """

    def __init__(self, coarse: int, fine: int, after: int) -> None:
        super().__init__(coarse + fine, after)
        self.coarse = coarse

    def forward(  # type: ignore[override]
        self, coarse: Float[Tensor, "N A h w"], fine: Float[Tensor, "N B r c"]
    ) -> Float[Tensor, "N C r c"]:
        """Return the maps of these cells."""
        up = interpolate(coarse, scale_factor=2.0)
        return super().forward(torch.cat([up, fine], 1))  # type: ignore[no-any-return]


class _Kept(NamedTuple):
    """Holds what was made of a network, and the tensors of it with the marks they had."""

    tensors: tuple[Tensor, ...]
    marks: list[int]
    network: nn.Module


_KEPT: WeakKeyDictionary[nn.Module, _Kept] = WeakKeyDictionary()


def for_inference(network: Network) -> Network:
    """Return the network, or a quicker one with the same results where it cannot learn from them.

    It is kept until the network is moved or a tensor of it is written to. `_core.module_state.derived`
    tells more kinds of change, but takes a tenth of a millisecond for as many tensors.
    """
    if network.training or torch.is_grad_enabled():
        return network
    kept = _KEPT.get(network)
    if kept is None or _marks(kept.tensors) != kept.marks:
        tensors = (*network.parameters(), *network.buffers())
        if any(tensor.is_inference() for tensor in tensors):  # whose changes leave no mark
            return network
        with outside_inference():
            kept = _KEPT[network] = _Kept(tensors, _marks(tensors), _folded(network))
    return cast(Network, kept.network)


def _marks(tensors: tuple[Tensor, ...]) -> list[int]:
    """Return the address of the first tensor and the versions of all."""
    return [tensors[0].data_ptr(), *[tensor._version for tensor in tensors]]


def _folded(network: Network) -> Network:
    """Return a copy whose layers have their normalisation in the convolution.

    Its maps keep the channels of a cell together, which convolutions on a CPU read fastest.
    """
    copy = deepcopy(network).requires_grad_(False).to(memory_format=torch.channels_last)
    _fold_children(copy)
    return copy


def _fold_children(module: nn.Module) -> None:
    for name, child in module.named_children():
        if isinstance(child, UpwardLayer):
            setattr(module, name, _FoldedUpwardLayer(child))
        elif isinstance(child, Layer):
            setattr(module, name, _FoldedLayer(child))
        else:
            _fold_children(child)


def _folded_weights(layer: Layer) -> tuple[Tensor, Tensor]:
    """Return the kernel and bias of a layer's convolution with its normalisation."""
    norm = cast(nn.BatchNorm2d, layer[1])
    mean, variance = cast(Tensor, norm.running_mean), cast(Tensor, norm.running_var)
    scale = norm.weight * (variance + norm.eps).rsqrt()
    return layer.convolution.weight * scale[:, None, None, None], norm.bias - mean * scale


class _FoldedLayer(nn.Module):
    """Does what a `Layer` does in inference."""

    def __init__(self, layer: Layer) -> None:
        super().__init__()
        conv = layer.convolution
        weight, bias = _folded_weights(layer)
        self.register_buffer("weight", weight.contiguous(memory_format=torch.channels_last))
        self.register_buffer("bias", bias)
        self.stride, self.apart = conv.stride, conv.dilation
        self.padding = cast(tuple[int, ...], conv.padding)

    weight: Tensor
    bias: Tensor

    def forward(self, maps: Float[Tensor, "N A h w"]) -> Float[Tensor, "N C r c"]:
        """Return the maps of the layer."""
        found = conv2d(maps, self.weight, self.bias, self.stride, self.padding, self.apart)
        return found.relu_()


class _FoldedUpwardLayer(nn.Module):
    """Does what an `UpwardLayer` does in inference.

    A wide cell covers two by two cells, so the sums of the kernel's weights over these are applied to it
    once: less than half the products, and no repeated maps.
    """

    def __init__(self, layer: UpwardLayer) -> None:
        super().__init__()
        weight, bias = _folded_weights(layer)
        coarse, fine = weight.split([layer.coarse, weight.shape[1] - layer.coarse], 1)
        sums = conv_transpose2d(
            coarse.flip(2, 3).flatten(0, 1)[:, None], coarse.new_ones(1, 1, 2, 2)
        )
        up = sums.view(*coarse.shape[:2], 4, 4).transpose(0, 1)
        self.register_buffer("up", up.contiguous(memory_format=torch.channels_last))
        self.register_buffer("weight", fine.contiguous(memory_format=torch.channels_last))
        self.register_buffer("bias", bias)

    up: Tensor
    weight: Tensor
    bias: Tensor

    def forward(
        self, coarse: Float[Tensor, "N A h w"], fine: Float[Tensor, "N B r c"]
    ) -> Float[Tensor, "N C r c"]:
        """Return the maps of these cells."""
        above = conv_transpose2d(coarse, self.up, stride=2, padding=1)
        return conv2d(fine, self.weight, self.bias, padding=1).add_(above).relu_()
