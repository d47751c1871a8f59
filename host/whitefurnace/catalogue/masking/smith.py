"""Smith's masking-shadowing, height-correlated, for any NDF that has Λ."""
from whitefurnace.catalogue.model import Model

ENTRY = Model(
    slot="masking",
    name="smith",
    title="Smith, height-correlated",
    citation="Heitz2014",
    parameters=(),
    provides=("MASKING_G1", "MASKING_G"),
    needs=("NDF_LAMBDA",),
    reference={"G1": lambda lv: 1 / (1 + lv), "G": lambda lv, ll: 1 / (1 + lv + ll)},
    facts={"reciprocal": True, "weak furnace": 1.0},
)
