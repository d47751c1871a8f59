"""Data about every model and integral, with float64 references.

A model is one entry here (`catalogue/SLOT/NAME.py`, a module with `ENTRY`) and one kernel file
(`kernels/SLOT/NAME.clh`). Entries are found by listing the folders, so adding a model touches nothing else.
"""

from whitefurnace.catalogue.model import Integral, Model, Parameter
from whitefurnace.catalogue.registry import INTEGRALS, SLOTS, integral, model, models

__all__ = ["INTEGRALS", "SLOTS", "Integral", "Model", "Parameter", "integral", "model", "models"]
