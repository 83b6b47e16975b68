"""A device that computes on the CPU and refuses what a GPU refuses: tensors of two devices in one operation.

Inside `pretended_device`, ``tensor.to(PRETENDED)`` and factories with ``device=PRETENDED`` make tensors whose
device is another than the CPU's. Numbers are those of the CPU.
"""

import contextlib
import functools
import inspect
import sys
from collections.abc import Iterator

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

PRETENDED = "meta"
"""The device under whose name the tensors go: torch needs no driver for it."""

_COPIES = {"aten::copy_", "aten::_to_copy", "aten::_copy_from"}
_INDEXED = {"aten::index.Tensor", "aten::index_put_", "aten::index_put", "aten::_index_put_impl_"}


class _Elsewhere(torch.Tensor):
    """A tensor of the CPU under the name of another device."""

    is_meta = False  # it holds numbers

    @staticmethod
    def __new__(cls, inner):
        return torch.Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(),
            dtype=inner.dtype, device=PRETENDED, requires_grad=False,
        )  # fmt: skip

    def __init__(self, inner):
        self.inner = inner

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})

    # in pieces, torch changes the shape of tensors in place
    def __matmul__(self, other):
        return _product(self, other)

    def __rmatmul__(self, other):
        return _product(other, self)

    def __deepcopy__(self, memo):
        return _Elsewhere(self.inner.clone())

    def tolist(self):
        return self.inner.tolist()

    def numpy(self, *, force=False):
        if not force:
            raise TypeError("the tensor is on another device than NumPy's arrays")
        return self.inner.numpy()

    def new_tensor(self, data, **options):
        return torch.tensor(data, **{"dtype": self.dtype, "device": "cpu", **options}).to(PRETENDED)

    def __getitem__(self, index):
        return super().__getitem__(_with_tensors(index))

    def __setitem__(self, index, value):
        super().__setitem__(_with_tensors(index), value)

    def __repr__(self):
        return f"elsewhere: {self.inner!r}"


class _Mode(TorchDispatchMode):
    @classmethod
    def _should_skip_dynamo(cls):
        return False  # to tell the compiler of each operation takes longer than to add

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


@contextlib.contextmanager
def pretended_device() -> Iterator[None]:
    """Let tensors be moved to the pretended device, and modules with `moved`."""
    with pytest.MonkeyPatch.context() as patch, torch.no_grad(), _without_caches(), _Mode():
        patch.setattr(torch, "tensor", _tensor_on(torch.tensor))
        patch.setattr(torch, "autocast", _autocast_on(torch.autocast))
        patch.setattr(torch, "Generator", _Generator)
        # subclasses have no views in inference mode
        patch.setattr(torch, "inference_mode", lambda mode=True: torch.no_grad())
        yield


@contextlib.contextmanager
def _without_caches():
    """Forget on both ends what functions of torchpose keep for a device: others use the same name."""
    kept = [
        value
        for name, module in list(sys.modules.items())
        if name.startswith("torchpose.")
        for value in vars(module).values()
        if hasattr(value, "cache_clear")
        and "device" in inspect.signature(value.__wrapped__).parameters
    ]
    for function in kept:
        function.cache_clear()
    try:
        yield
    finally:
        for function in kept:
            function.cache_clear()


def moved(module, device):
    """Return the module on a device."""
    before = torch.__future__.get_swap_module_params_on_conversion()
    torch.__future__.set_swap_module_params_on_conversion(device == PRETENDED)
    try:
        return module.to(device)
    finally:
        torch.__future__.set_swap_module_params_on_conversion(before)


_made = torch.Generator


class _AnyGenerator(type(_made)):
    def __instancecheck__(cls, value):
        return isinstance(value, _made)


class _Generator(_made, metaclass=_AnyGenerator):
    """The CPU's generator, under the name of the pretended device too."""

    def __new__(cls, device="cpu"):
        return _made("cpu" if torch.device(device).type == PRETENDED else device)


def _tensor_on(made):
    # torch makes no data of Python's numbers for the meta device
    def tensor(data, *, dtype=None, device=None, **options):
        here = made(data, dtype=dtype, **options)
        return here if device is None else here.to(device)

    return tensor


def _autocast_on(entered):
    def autocast(device_type, *options, **named):
        if device_type == PRETENDED:
            return contextlib.nullcontext()
        return entered(device_type, *options, **named)

    return autocast


def _product(one, other):
    with torch._C._DisableTorchDispatch():  # its pieces are of tensors of the CPU
        return _run(torch.ops.aten.matmul.default, (one, other), {})


def _run(func, args, kwargs):
    tensors = _tensors_in((args, *kwargs.values()) if kwargs else args)
    there = any(type(x) is _Elsewhere for x in tensors)
    wanted = kwargs.get("device")
    if wanted is not None:
        elsewhere = torch.device(wanted).type == PRETENDED
        kwargs = {**kwargs, "device": torch.device("cpu")}
    else:
        elsewhere = there
    name, full = _names(func) if there else ("", "")
    if there and name not in _COPIES:
        checked = tensors
        if full in _INDEXED:  # indices may lie anywhere
            checked = [args[0], *args[2:3]]
        strangers = [x for x in checked if not isinstance(x, _Elsewhere) and x.ndim > 0]
        if strangers:
            raise RuntimeError(
                f"{full}: tensors of two devices, one of shape {list(strangers[0].shape)}"
            )
    if there:
        own = [_inner(x) for x in args]
        result = func(*own, **{key: _inner(value) for key, value in kwargs.items()})
    else:
        result = func(*args, **kwargs)
    if there and args and result is own[0]:  # in place
        return args[0]
    return _outer(result) if elsewhere else result


@functools.cache
def _names(func):
    """Return the name of an operation, without and with that of its overload."""
    name = func._schema.name
    return name, f"{name}.{func._overloadname}" if func._overloadname != "default" else name


def _tensors_in(values):
    """Return the tensors of sequences in sequences; torch's own trees take several times as long."""
    found = []
    for value in values:
        if isinstance(value, torch.Tensor):
            found.append(value)
        elif isinstance(value, tuple | list):
            found += _tensors_in(value)
    return found


def _with_tensors(index):
    """Return an index whose places are tensors: a list, or of several axes a tuple inside."""
    return tuple(map(_as_tensor, index)) if isinstance(index, tuple) else _as_tensor(index)


def _as_tensor(places):
    return torch.tensor(places).to(PRETENDED) if isinstance(places, list | tuple) else places


def _inner(x):
    if isinstance(x, _Elsewhere):
        return x.inner
    return type(x)(map(_inner, x)) if type(x) in (tuple, list) else x


def _outer(x):
    if isinstance(x, torch.Tensor):
        return _Elsewhere(x)
    return type(x)(map(_outer, x)) if type(x) in (tuple, list) else x
