"""Tolerances of this folder, each relative to the motion: its sizes, its fastest event, its period.

The figures "below" and "above" are the largest number that counted as zero, and the smallest one
that did not, in 67 tests of branches, boundaries and grazings.
"""

# The corrector's last correction, in scaled unknowns. A flight with enough steps changes by less,
# along a curve by less than ten times that; so do the sections of a motion that has settled. On
# steep curves rounding keeps corrections above it, up to the second number. That is also the
# accuracy of what is called resolved: a curve between its nodes, a motion that repeats, its steps.
CORRECTED, ROUGHLY = 1e-11, 1e-8

# A number of so many roundings of those that it is computed from is zero: a choice, some times the
# error of their sum.
ROUNDINGS = 16

# A parameter or a guard is at a value to rounding: a choice, below the corrector's tolerance.
EXACT = 1e-12

# Zero to rounding on a corrected motion: a speed or a clearance beyond its sign (below 6e-14, above
# none), a rate, a size, 1 - |multiplier|.
ROUNDING = 1e-9

# Zero at a located point: the speed of an event that is lost (below 2e-14, above 7e-4), a touched
# stop, the test of a bifurcation, the time between events that coincide. The corrector leaves up to
# 5e-8 at the release from a soft stop that grazes. A multiplier is on the unit circle within ten
# times that. Simulations with a minimal kick larger and smaller by this share confirm it.
LOCATED = 1e-6
ON_CIRCLE = 10 * LOCATED

# Places closer in time than this (a cycle is 2π) are one: between them a motion turns by `LOCATED`.
BRIEF = LOCATED**0.5

# The distance of two solutions that are one motion, as where a curve closes (below 9e-13, above
# 7e-5), or of a motion from its own repetition or image.
SAME = 1e-7

# Two motions are near each other: an orbit and its solution from event to event or a motion that
# is known roughly, both halves of a period near a doubling, a motion beyond a grazing and itself a
# period later. A choice: along a branch the difference from the own image takes all values (5e-4
# and 1e-3 were met).
ALIKE = 1e-3

# Shares far above what the corrector leaves at a located place and below what differs. The first:
# multipliers are equal, an entry of a local map is zero, an extremum is no corner, events coincide,
# a part of the period or the rebound of a hop vanishes, two kicks are one, a curve hardly rises in
# a parameter. The second: solutions are near enough to search for one from the other, their
# tangents are the same, a motion is about to shrink to rest; for both halves of a period near a
# doubling: with twelve impacts in 32π the corrector fails from four times `ALIKE` on. Choices.
FAINT, NEARBY = 1e-4, 1e-2

# Most events of a cycle that are listed, with hops, switches and sections: a choice.
LISTED = 32
