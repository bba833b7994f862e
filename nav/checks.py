"""Arrays that a caller hands to compiled kernels, which read and write by shape and check nothing."""

import numpy as np
from numpy.typing import ArrayLike

from nav.errors import HilError
from nav.increments import FloatArray


def read_array(what: str, values: ArrayLike, *shape: int) -> FloatArray:
    """`values` as contiguous, writable floats: a kernel is compiled for no other.

    Raises
    ------
    HilError
        It has another shape.
    """
    if type(values) is np.ndarray and values.shape == shape and values.dtype == np.float64 and values.flags.carray:
        return values
    array = np.ascontiguousarray(values, np.float64)
    if array.shape != shape:
        raise HilError(f"{what}: shape {array.shape} where {shape} is needed")
    return array if array.flags.writeable else array.copy()


def check_room(what: str, array: FloatArray, *shape: int) -> None:
    """Refuse room for answers that a kernel cannot fill.

    Raises
    ------
    HilError
        No contiguous, writable array of floats (float64), or another shape.
    """
    if array.shape != shape:
        raise HilError(f"{what}: shape {array.shape} where {shape} is needed")
    if array.dtype != np.float64 or not array.flags.carray:
        raise HilError(f"{what}: {array.dtype} where a contiguous, writable array of float64 is needed")
