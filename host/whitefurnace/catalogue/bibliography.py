"""The papers that entries and kernels cite, by key."""

PAPERS = {
    "Heitz2014": "E. Heitz, Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs, JCGT 3(2), 2014",
    "Hoffman2012": "N. Hoffman, Background: Physics and Math of Shading, SIGGRAPH 2012 course",
    "Karis2013": "B. Karis, Real Shading in Unreal Engine 4, SIGGRAPH 2013 course",
    "Lagarde2014": "S. Lagarde, C. de Rousiers, Moving Frostbite to Physically Based Rendering, SIGGRAPH 2014 course",
    "Ramamoorthi2001": "R. Ramamoorthi, P. Hanrahan, An Efficient Representation for Irradiance Environment Maps, "
                       "SIGGRAPH 2001",
    "Schlick1994": "C. Schlick, An Inexpensive BRDF Model for Physically-Based Rendering, CGF 13(3), 1994",
    "VanOosterom1983": "A. Van Oosterom, J. Strackee, The Solid Angle of a Plane Triangle, IEEE TBME 30(2), 1983",
    "Walter2007": "B. Walter et al., Microfacet Models for Refraction through Rough Surfaces, EGSR 2007",
}
