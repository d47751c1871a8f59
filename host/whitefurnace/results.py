"""The result type of integrals: an array with its estimated error."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Integrated:
    """The result of `integrate`: an array with its estimated error.

    values       array of the broadcast shape of the parameters, with a trailing axis for a vector integral
    error        estimated absolute error, the largest over all cells
    evaluations  number of integrand evaluations of the finest rule, all cells together
    seconds      wall time
    rule         name of the finest quadrature rule that was used
    notices      sentences about work that was not requested, such as cells computed in float64
    errors       estimated absolute errors of the cells: array of the shape of `values` without the axis of a vector
                 integral's components, of which each cell has the largest; None where they were not asked for
    """

    values: np.ndarray
    error: float
    evaluations: int
    seconds: float
    rule: str
    notices: tuple[str, ...] = field(default=())
    errors: np.ndarray | None = None

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.values, dtype=dtype) if dtype or copy else self.values
