"""Silicones for soft robots: published parameters, with the source and the range of each number.

Parameters are those of the isochoric part of the law and were found for an incompressible solid. The same product
differs by a factor of up to two between sources, batches and cures, and by the first stretches of a part (Mullins
effect): fit the modulus on the part itself where it matters.

Rights: parameters of Dawood et al. come from data under CC BY 4.0 and are rounded here. Those fitted to the curves of
Marechal et al. are a produced work from the Soft Robotics Materials Database, which is made available under the Open
Database License (ODbL 1.0). The work of Johnston et al. is under CC BY 3.0.
"""

from __future__ import annotations

from dataclasses import dataclass

from softwarp.advice import nearest

DAWOOD = (
    "A. B. Dawood, Z. Zhang, D. Osman, C. Suulker, A. Abdulali, M. Angelmahr, K. Althoefer, Hyperelastic "
    "Characterisation of Silicone Tissue Phantoms: A Parametric Database with Model Selection and Inverse Design "
    "Framework, 2026, github.com/abubakardawood/tissue-phantom-material-database (CC BY 4.0): Yeoh, third order"
)
MARECHAL = (
    "fitted here to the raw curve of L. Marechal, P. Balland, L. Lindenroth, F. Petrou, C. Kontovounisios, F. Bello, "
    "Toward a Common Framework and Database of Materials for Soft Robotics, Soft Robotics 8(3), 2021, 284-297, "
    "doi 10.1089/soro.2019.0115, github.com/LucMarechal/Soft-Robotics-Materials-Database (ODbL 1.0)"
)
COMPRESSION = "uniaxial compression to stretch 0.33; tension to 1.8, beyond it is too stiff"
TENSION = "uniaxial tension, stretch 1.1 to 3, first cycle; at small strain up to two times softer than other sources"


@dataclass(frozen=True)
class Silicone:
    """A product with the parameters of one source.

    Attributes:
        name: Product, and what sets this entry apart from others of the same product.
        law: Name of the material's class.
        parameters: Its parameters [Pa; exponents are numbers] without ``bulk`` and ``nu``.
        density: Density [kg/m^3], of the maker's data sheet where the source has none.
        range: Kind of test and stretches in which the parameters hold.
        source: Where the parameters come from.
    """

    name: str
    law: str
    parameters: dict[str, float]
    density: float
    range: str
    source: str


SILICONES = {
    entry.name: entry
    for entry in (
        Silicone("Ecoflex 00-10", "Yeoh", {"c10": 7702.0, "c20": -62.81, "c30": 247.9}, 1040.0, COMPRESSION, DAWOOD),
        Silicone(
            "Ecoflex 00-30",
            "Yeoh",
            {"c10": 13864.0, "c20": 189.7, "c30": 15.0},
            1070.0,
            "tension, first cycle: uniaxial and equibiaxial to stretch 3, planar to 2.55; 2.6 % rms over the three",
            "fitted here to figures 4a, 8a and 12a, as digitised in github.com/via-balaena/CortenForge, of Z. Liao, "
            "J. Yang, M. Hossain, On the stress recovery behaviour of Ecoflex silicone rubbers, Int. J. Mech. Sci. "
            "206, 2021, 106624, doi 10.1016/j.ijmecsci.2021.106624",
        ),
        Silicone(
            "Ecoflex 00-30 compression",
            "Yeoh",
            {"c10": 14690.0, "c20": -194.4, "c30": 310.7},
            1070.0,
            COMPRESSION,
            DAWOOD,
        ),
        Silicone("Ecoflex 00-50", "Yeoh", {"c10": 23333.0, "c20": -494.1, "c30": 491.8}, 1070.0, COMPRESSION, DAWOOD),
        Silicone(
            "Dragon Skin 10",
            "NeoHookean",
            {"youngs": 263.8e3},
            1070.0,
            "loaded cantilever, small strain; the maker's modulus at 100 % (22 psi) agrees",
            "M. Dubied, M. Y. Michelis, A. Spielberg, R. K. Katzschmann, Sim-to-Real for Soft Robots using "
            "Differentiable FEM: Recipes for Meshing, Damping, and Actuation, IEEE Robotics and Automation Letters, "
            "2022, arXiv 2201.12560, github.com/srl-ethz/diffPD_sim2real",
        ),
        Silicone("Dragon Skin 10 tension", "Ogden", {"mu_1": 40397.0, "alpha_1": 3.2123}, 1070.0, TENSION, MARECHAL),
        Silicone("Dragon Skin 20", "Ogden", {"mu_1": 113530.0, "alpha_1": 3.1461}, 1080.0, TENSION, MARECHAL),
        Silicone("Dragon Skin 30", "Ogden", {"mu_1": 171300.0, "alpha_1": 2.9613}, 1080.0, TENSION, MARECHAL),
        Silicone(
            "Elastosil M4601",
            "Yeoh",
            {"c10": 110.0e3, "c20": 20.0e3, "c30": 0.0},
            1130.0,
            "not stated; usual in models of pneumatic fingers",
            "as quoted by others, such as the preset Elastosil28 of github.com/BJCaasenbrood/SorotokiCode; the "
            "measurement behind it was not found",
        ),
        Silicone(
            "Sylgard 184",
            "NeoHookean",
            {"youngs": 2.05e6},
            1030.0,
            "mixed 10:1, cured 48 min at 100 C, on which it depends much; strain below 0.4",
            "I. D. Johnston et al., Mechanical characterization of bulk Sylgard 184 for microfluidics and "
            "microengineering, J. Micromech. Microeng. 24, 2014, 035017, doi 10.1088/0960-1317/24/3/035017, table 2, "
            "as quoted by others",
        ),
    )
}


def silicone(name: str) -> Silicone:
    """The entry of a silicone by name, whatever its case.

    Raises:
        ValueError: If there is none; the message lists the nearest names.
    """
    found = {key.lower(): entry for key, entry in SILICONES.items()}.get(str(name).lower())
    if found is None:
        raise ValueError(f"no silicone is called {name!r}; {nearest(name, SILICONES)}")
    return found
