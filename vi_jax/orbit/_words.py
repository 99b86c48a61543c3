"""What is said of the special points of a branch, by their kinds."""

from .special import CROSSING, DOUBLING, FOLD, SYMMETRY, TORUS, TURN

# Stand in the place of the number of an impact, for what grazes without being one.
REORDERED, RESTS, ANEW = -1, -2, -3

# What is said of a special point, by its kind or by what stands for the impact.
DETAILS = {
    FOLD: "a multiplier passes 1 and the branch turns back",
    DOUBLING: "a multiplier passes -1",
    CROSSING: "a multiplier passes 1 and another branch crosses",
    SYMMETRY: "a multiplier passes 1 and the motion loses its symmetry",
    TORUS: "a complex pair of multipliers leaves the unit circle",
    TURN: "the parameter turns back where it is followed under conditions",
    REORDERED: "two of its events fall together, and come in another order beyond",
    ANEW: "a switch goes into another mode: the motion sticks or slips anew",
}

# The same of a fold where numbers are held: the parameter alone would turn back.
HELD_FOLD = "a multiplier passes 1"
