"""The one way hot loops are compiled: numba, kept on disk, without the interpreter's lock.

A kernel calls kernels of its own file only: numba looks at that file alone to
see whether what it kept on disk is still true.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np
from llvmlite import binding as llvm
from numpy.typing import NDArray

_P = ParamSpec("_P")
_R = TypeVar("_R")
_Number = TypeVar("_Number", bound=np.generic)

_KERNELS: list[Any] = []


def compiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a kernel at its first call, or load it from where an earlier process put it.

    Numba keeps its code in ``NUMBA_CACHE_DIR``, else beside the source, else in
    the user's cache folder. Where none of them can be written (a service of a
    user without a home) the kernel is compiled anew in every process: slower to
    start, never a failure.

    Args:
        function: only numbers, arrays and tuples; division by zero gives infinity.

    Returns:
        The compiled function, called like the original.
    """
    return _compiled(function, False)


def reordered(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Compile a kernel whose sums may be added up in any order, and so many numbers at once.

    What is no number, or infinite, stays so; otherwise as ``compiled``.
    """
    return _compiled(function, {"reassoc", "contract", "nsz"})


def _compiled(function: Callable[_P, _R], fastmath: bool | set[str]) -> Callable[_P, _R]:
    compiler = numba.njit(nogil=True, error_model="numpy", fastmath=fastmath)
    try:
        kept = numba.njit(nogil=True, error_model="numpy", fastmath=fastmath, cache=True)(function)
    except RuntimeError:  # "no locator available": there is no folder to keep it in
        kept = compiler(function)
    _KERNELS.append(kept)
    return cast("Callable[_P, _R]", kept)


def writable(values: NDArray[_Number]) -> NDArray[_Number]:
    """Return an array as kernels take all of theirs: for another kind they are compiled anew."""
    return np.require(values, requirements=["C", "W"])


def pack_kernels() -> None:
    """Have kernels that were called keep what others would be linked with as bytes.

    LLVM keeps it parsed, half a megabyte for each kernel, for others that are compiled later:
    none are as a rule, and if so, it is parsed again.
    """
    for kernel in _KERNELS:
        for overload in kernel.overloads.values():
            _pack(overload.library)


def _pack(library: Any) -> None:
    # Inside of numba; another release may have it otherwise, and more memory.
    module = getattr(library, "_shared_module", None)
    if module is None or not hasattr(library, "_get_module_for_linking"):
        return
    bitcode = module.as_bitcode()
    library._get_module_for_linking = lambda: llvm.parse_bitcode(bitcode)
    library._shared_module = None
