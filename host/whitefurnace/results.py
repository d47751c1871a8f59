"""Results of integrals, as arrays with their stated error."""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Integrated:
    """The result of `integrate`.

    `values` has the broadcast shape of the parameters, with a trailing axis for a vector integral; `error` is
    the estimated absolute error, the largest over all cells; `rule` names the finest rule that was used and
    `evaluations` counts its integrand evaluations, all cells together; `seconds` is the wall time; `notices` say
    what was done that was not asked for, such as cells taken to float64.
    """

    values: np.ndarray
    error: float
    evaluations: int
    seconds: float
    rule: str
    notices: tuple[str, ...] = field(default=())

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.values, dtype=dtype) if dtype or copy else self.values
