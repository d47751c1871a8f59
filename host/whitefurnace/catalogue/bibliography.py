"""The bibliography: every paper that kernels, catalogue entries and the engine cite, by key.

An entry of the catalogue brings the paper that it is from (`citation=Paper(…)`). Papers that belong to no single entry,
since the engine or several of them cite them, are listed here; an entry takes one of these with `cited`. It takes a
paper that another entry brings from that entry (`citation=CHARLIE.citation`).
"""

from __future__ import annotations

from whitefurnace.catalogue.model import Paper
from whitefurnace.catalogue.registry import SLOTS, models

SHARED = {
    "Bruneton2008": "E. Bruneton, F. Neyret, Precomputed Atmospheric Scattering, CGF 27(4), 2008",
    "Burley2012": "B. Burley, Physically Based Shading at Disney, SIGGRAPH 2012 course",
    "CIE15": "Commission Internationale de l'Éclairage, Colorimetry, 4th edition, CIE 015:2018",
    "ChristensenBurley2015": "P. H. Christensen, B. Burley, Approximate Reflectance Profiles for Efficient Subsurface "
    "Scattering, Pixar Technical Memo 15-04, 2015",
    "Cigolle2014": "Z. H. Cigolle, S. Donow, D. Evangelakos, M. Mara, M. McGuire, Q. Meyer, A Survey of Efficient "
    "Representations for Independent Unit Vectors, JCGT 3(2), 2014",
    "Clenshaw1955": "C. Clenshaw, A Note on the Summation of Chebyshev Series, MTAC 9(51), 1955",
    "Colbert2007": "M. Colbert, J. Křivánek, GPU-Based Importance Sampling, GPU Gems 3, chapter 20, 2007",
    "dEonLuebke2007": "E. d'Eon, D. Luebke, Advanced Techniques for Realistic Real-Time Skin Rendering, GPU Gems 3, "
    "chapter 14, 2007",
    "Dupuy2023": "J. Dupuy, A. Benyoub, Sampling Visible GGX Normals with Spherical Caps, CGF 42(8), 2023",
    "FdezAguera2019": "C. J. Fdez-Agüera, A Multiple-Scattering Microfacet Model for Real-Time Image-Based Lighting, "
    "JCGT 8(1), 2019",
    "Frisvad2012": "J. R. Frisvad, Building an Orthonormal Basis from a 3D Unit Vector Without Normalization, Journal "
    "of Graphics Tools 16(3), 2012",
    "Fujii2012": "Y. Fujii, A Tiny Improvement of Oren-Nayar Reflectance Model, 2012",
    "Goldfarb1983": "D. Goldfarb, A. Idnani, A Numerically Stable Dual Method for Solving Strictly Convex Quadratic "
    "Programs, Mathematical Programming 27, 1983",
    "Hammon2017": "E. Hammon, PBR Diffuse Lighting for GGX+Smith Microsurfaces, GDC 2017",
    "Heitz2014": "E. Heitz, Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs, JCGT 3(2), 2014",
    "Heitz2016": "E. Heitz, J. Dupuy, S. Hill, D. Neubelt, Real-Time Polygonal-Light Shading with Linearly Transformed "
    "Cosines, ACM TOG 35(4), 2016",
    "Hoffman2012": "N. Hoffman, Background: Physics and Math of Shading, SIGGRAPH 2012 course",
    "Jensen2001": "H. W. Jensen, S. Marschner, M. Levoy, P. Hanrahan, A Practical Model for Subsurface Light "
    "Transport, SIGGRAPH 2001",
    "Kahan1965": "W. Kahan, Further Remarks on Reducing Truncation Errors, Communications of the ACM 8(1), 1965",
    "Karis2013": "B. Karis, Real Shading in Unreal Engine 4, SIGGRAPH 2013 course",
    "Karis2014": "B. Karis, Physically Based Shading on Mobile, Unreal Engine blog, 2014",
    "Krivanek2008": "J. Křivánek, M. Colbert, Real-Time Shading with Filtered Importance Sampling, CGF 27(4), 2008",
    "KullaConty2017": "C. Kulla, A. Conty, Revisiting Physically Based Shading at Imageworks, SIGGRAPH 2017 course",
    "Lagarde2014": "S. Lagarde, C. de Rousiers, Moving Frostbite to Physically Based Rendering, SIGGRAPH 2014 course",
    "Lawson1961": "C. L. Lawson, Contributions to the Theory of Linear Least Maximum Approximation, PhD thesis, UCLA, "
    "1961",
    "Mahy1994": "M. Mahy, L. Van Eycken, A. Oosterlinck, Evaluation of Uniform Color Spaces Developed after the "
    "Adoption of CIELAB and CIELUV, Color Research and Application 19(2), 1994",
    "Marquardt1963": "D. W. Marquardt, An Algorithm for Least-Squares Estimation of Nonlinear Parameters, SIAM J. "
    "Appl. Math. 11(2), 1963",
    "McCalpin1995": "J. McCalpin, Memory Bandwidth and Machine Balance in Current High Performance Computers, IEEE "
    "TCCA Newsletter, 1995",
    "MoreSorensen1983": "J. J. Moré, D. C. Sorensen, Computing a Trust Region Step, SIAM J. Sci. Stat. Comput. 4(3), "
    "1983",
    "Narkowicz2015": "K. Narkowicz, ACES Filmic Tone Mapping Curve, 2015",
    "OrenNayar1994": "M. Oren, S. Nayar, Generalization of Lambert's Reflectance Model, SIGGRAPH 1994",
    "Penner2011": "E. Penner, G. Borshukov, Pre-Integrated Skin Shading, GPU Pro 2, 2011",
    "PopeFry1997": "R. M. Pope, E. S. Fry, Absorption Spectrum (380-700 nm) of Pure Water. II. Integrating Cavity "
    "Measurements, Applied Optics 36(33), 1997",
    "Praun2003": "E. Praun, H. Hoppe, Spherical Parametrization and Remeshing, ACM TOG 22(3), 2003",
    "Ramamoorthi2001": "R. Ramamoorthi, P. Hanrahan, An Efficient Representation for Irradiance Environment Maps, "
    "SIGGRAPH 2001",
    "Reinhard2002": "E. Reinhard, M. Stark, P. Shirley, J. Ferwerda, Photographic Tone Reproduction for Digital Images,"
    " ACM TOG 21(3), 2002",
    "Schlick1994": "C. Schlick, An Inexpensive BRDF Model for Physically-Based Rendering, CGF 13(3), 1994",
    "Shirley1997": "P. Shirley et al., A Practitioners' Assessment of Light Reflection Models, Pacific Graphics 1997",
    "Sloan2017": "P.-P. Sloan, Deringing Spherical Harmonics, SIGGRAPH Asia technical briefs, 2017",
    "Snyder1996": "J. Snyder, Area Light Sources for Real-Time Graphics, Microsoft Research MSR-TR-96-11, 1996",
    "Turquin2019": "E. Turquin, Practical Multiple Scattering Compensation for Microfacet Models, Industrial Light & "
    "Magic, 2019",
    "VanOosterom1983": "A. Van Oosterom, J. Strackee, The Solid Angle of a Plane Triangle, IEEE TBME 30(2), 1983",
    "Vogel1979": "H. Vogel, A Better Way to Construct the Sunflower Head, Mathematical Biosciences 44, 1979",
    "Walter2007": "B. Walter et al., Microfacet Models for Refraction through Rough Surfaces, EGSR 2007",
    "Wang2012": "H. Wang, S. Xiang, On the Convergence Rates of Legendre Approximation, Mathematics of Computation "
    "81(278), 2012",
    "Weiszfeld1937": "E. Weiszfeld, Sur le point pour lequel la somme des distances de n points donnés est minimum, "
    "Tôhoku Mathematical Journal 43, 1937",
    "WilsonHilferty1931": "E. B. Wilson, M. M. Hilferty, The Distribution of Chi-Square, PNAS 17(12), 1931",
}
"""Papers by key that belong to no single entry."""


def cited(key: str) -> Paper:
    """Return the shared paper `key`, for an entry. Raises KeyError where the list has none."""
    return Paper(key, SHARED[key])


def bibliography() -> dict[str, Paper]:
    """Return all papers by key, in alphabetical order: the shared ones and those that entries bring."""
    found = {key: Paper(key, text) for key, text in SHARED.items()}
    for slot in SLOTS:
        for entry in models(slot).values():
            found |= {paper.key: paper for paper in (entry.citation, *entry.also_cited)}
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))
