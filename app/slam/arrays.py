"""The array types that this package uses, and a vector of three numbers."""

import numpy as np
import numpy.typing as npt
from pydantic import FiniteFloat

F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]
Mask = npt.NDArray[np.bool_]
Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
"""pydantic refuses nan and infinity in it."""
