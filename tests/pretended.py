"""A pretended accelerator: tensors of a device ``pretended`` that refuse what CUDA's refuse, computed on the CPU.

A PrivateUse1 backend written in Python: no compiler, no driver. Its tensors do not mix with the CPU's (zero-dimensional
ones and the indices of a look-up may come from there, as on CUDA), are not seen by numpy, and take no CPU generator;
autograd runs their backward passes in a thread of the device. What an operation gives is what the CPU gives.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.utils._python_dispatch import return_and_correct_aliasing
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

NAME = "pretended"
aten = torch.ops.aten
CROSSING = {aten.copy_.default, aten._to_copy.default}  # they move values between devices
INDEXING = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default}
SCALARS = {aten.fill_.Tensor, aten.where.self, aten.masked_fill.Tensor, aten.masked_fill_.Tensor}
used: set[str] = set()  # names of the operations that have run on the device
BY_CHANCE = {  # those whose order of additions is another one each time on CUDA, or on the CPU's threads
    "index_add",
    "index_put, accumulating",
    "index_reduce",
    "scatter_add",
    "scatter_reduce",
    "put",
    "cumsum",
    "bincount",
    "histc",
    "grid_sampler_2d_backward",
    "grid_sampler_3d_backward",
    "upsample_linear1d_backward",
    "upsample_bilinear2d_backward",
    "upsample_nearest2d_backward",
    "max_pool3d_with_indices_backward",
    "adaptive_avg_pool2d_backward",
    "reflection_pad2d_backward",
    "replication_pad2d_backward",
    "embedding_dense_backward",
    "segment_reduce_backward",
}


class PretendedTensor(torch.Tensor):
    """A tensor of the device: its values are in ``inner``, a tensor of the CPU that nothing else sees."""

    inner: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: Tensor):
        options = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        made = Tensor._make_wrapper_subclass(cls, inner.shape, device=torch.device(NAME, 0), **options)
        made.inner = inner
        return made

    def numpy(self, *, force=False):
        """What CUDA says; `numpy.asarray` comes here, too."""
        raise TypeError(f"can't convert {self.device} device type tensor to numpy. Use Tensor.cpu() to copy it first.")

    def tolist(self):
        """Numbers of Python, as every device gives them."""
        return self.detach().cpu().tolist()

    def __repr__(self):
        return f"{NAME} {self.inner!r}"

    def __reduce_ex__(self, protocol):
        return torch._utils._rebuild_device_tensor_from_cpu_tensor, (
            self.detach().cpu(),
            self.dtype,
            str(self.device),
            self.requires_grad,
        )

    @classmethod
    def __torch_dispatch__(cls, operation, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        name = operation._schema.name.removeprefix("aten::").strip("_").removesuffix("_impl")
        used.add(f"{name}, accumulating" if name == "index_put" and len(args) > 3 and args[3] else name)
        check_devices(operation, args, kwargs)
        device, options = kwargs.get("device"), kwargs
        if device is not None:
            options = kwargs | {"device": torch.device("cpu")}
        found = operation(*unwrap(args), **{key: unwrap(value) for key, value in options.items()})
        if device is not None and torch.device(device).type != NAME:
            return found
        if operation is aten.copy_.default:
            return args[0]
        return return_and_correct_aliasing(operation, args, kwargs, wrap(found)) if aliases(operation) else wrap(found)


@cache
def aliases(operation) -> bool:
    """Whether an operation gives a view of an argument, or writes to one.

    Raises:
        NotImplementedError: for one that changes the shape of a tensor in place.
    """
    if torch.Tag.inplace_view in operation.tags:
        raise NotImplementedError(f"{operation}: changes the shape of a tensor in place.")
    schema = operation._schema
    return any(part.alias_info is not None for part in (*schema.arguments, *schema.returns))


def unwrap(value):
    """A value, or a nest of them, with the tensors of the CPU in the place of the device's."""
    if isinstance(value, (list, tuple)):
        return type(value)(map(unwrap, value))
    return value.inner if isinstance(value, PretendedTensor) else value


def wrap(value):
    """What an operation gave, as the device's."""
    if isinstance(value, (list, tuple)):
        return type(value)(map(wrap, value))
    return PretendedTensor(value) if isinstance(value, Tensor) else value


def leaves_of(value):
    """The values in a nest of them."""
    if isinstance(value, (list, tuple)):
        for item in value:
            yield from leaves_of(item)
    else:
        yield value


def check_devices(operation, args, kwargs) -> None:
    """Refuses tensors of two devices and CPU generators, but where CUDA does not."""
    if operation in INDEXING and isinstance(args[0], PretendedTensor):
        args = (args[0], *args[2:])  # the indices may be the CPU's
    strange = []
    for value in leaves_of((*args, *kwargs.values())):
        if isinstance(value, torch.Generator) and value.device.type != NAME:
            raise RuntimeError(f"Expected a '{NAME}' device type for generator but found '{value.device.type}'")
        if isinstance(value, Tensor) and not isinstance(value, PretendedTensor):
            strange.append(value)
    if not strange or operation in CROSSING:
        return
    scalars = torch.Tag.pointwise in operation.tags or operation in SCALARS or operation in INDEXING
    written = operation._schema.is_mutable and strange[0] is args[0]
    if written or any(value.dim() or not scalars for value in strange):
        raise RuntimeError(
            f"Expected all tensors to be on the same device, but found at least two devices, {NAME}:0 and cpu! "
            f"(in {operation})"
        )


class PretendedModule:
    """What torch asks of a device's module."""

    is_available = is_initialized = staticmethod(lambda: True)
    current_device = staticmethod(lambda: 0)
    device_count = staticmethod(lambda: 1)
    _is_in_bad_fork = staticmethod(lambda: False)
    manual_seed_all = staticmethod(lambda seed: None)
    get_amp_supported_dtype = staticmethod(lambda: [torch.bfloat16, torch.float16])


def empty(size, *, dtype=None, layout=None, device=None, pin_memory=None, memory_format=None):
    return PretendedTensor(torch.empty(size, dtype=dtype, memory_format=memory_format or torch.contiguous_format))


def empty_strided(size, stride, *, dtype=None, layout=None, device=None, pin_memory=None):
    return PretendedTensor(torch.empty_strided(size, stride, dtype=dtype))


def copy_from(source, target, non_blocking=False):
    """What ``torch.tensor(..., device=...)`` moves its values by: below `PretendedTensor.__torch_dispatch__`."""
    unwrap(target).copy_(unwrap(source))
    return target


def counting(make):
    """A factory whose result's size is not known before: made on the CPU and taken over."""

    def factory(*args, dtype=None, layout=None, device=None, pin_memory=None):
        return PretendedTensor(make(*args, dtype=dtype))

    return factory


def install() -> torch.device:
    """Registers the device, once a process; gives it."""
    if NAME not in vars(torch):
        _setup_privateuseone_for_python_backend(NAME, PretendedModule)
        library = install.library = torch.library.Library("aten", "IMPL")
        library.impl("empty.memory_format", empty, "PrivateUse1")
        library.impl("empty_strided", empty_strided, "PrivateUse1")
        for name, make in (("arange.start_step", torch.arange), ("linspace", torch.linspace), ("eye", torch.eye)):
            library.impl(name, counting(make), "PrivateUse1")
        library.impl("_copy_from", copy_from, "PrivateUse1")
        install.autocast = torch.library.Library("_", "IMPL")
        install.autocast.fallback(torch.library.fallthrough_kernel, "AutocastPrivateUse1")
    return torch.device(NAME, 0)
