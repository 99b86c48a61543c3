"""Invalid parameters of ready machines raise an error that names them."""

import pytest
import vi_jax as vi

M = vi.machines
NAN, ROTOR = float("nan"), vi.machines.UnbalancedRotor
WRONG = [
    (M.BouncingBall, "acceleration", -1.0), (M.BouncingBall, "restitution", 1.5),
    (M.ImpactPair, "half_gap", 0.0), (M.ImpactPair, "mass_ratio", NAN),
    (M.Duffing, "gap", -1.0), (M.Duffing, "frequency", 0.0),
    (M.Capsule, "mass_ratio", 0.0), (M.Capsule, "friction", -1.0),
    (M.Capsule, "static_ratio", 0.9), (M.Capsule, "frequency", 0.0),
    (M.Capsule, "restitution", 1.1), (M.Capsule, "damping_ratio", "x"),
    (ROTOR, "coupling", 1.0), (ROTOR, "strength", -1.0), (ROTOR, "no_load_speed", 0.0),
    (ROTOR, "gap", 0.0), (ROTOR, "restitution", 1.5), (ROTOR, "damping_ratio", -0.1),
    (ROTOR, "control", NAN), (ROTOR, "coupling", 0.0),
    (M.ReliefValve, "flow_rate", 0.0), (M.ReliefValve, "compressibility", -1.0),
    (M.Woodpecker, "friction", -0.1), (M.Woodpecker, "bird_mass", 0.0),
    (M.Woodpecker, "sleeve_radius", 0.0025),
    (M.Beam, "modes", 0), (M.Beam, "place", 0.0), (M.Beam, "place", 1.1),
    (M.Beam, "damping_ratio", [0.1, 0.1]), (M.Beam, "shaken", "middle"), (M.Beam, "length", 0.0),
]  # fmt: skip


@pytest.mark.parametrize(("make", "name", "value"), WRONG)
def test_wrong_parameters_raise_with_their_names(make, name, value):
    with pytest.raises((ValueError, TypeError), match=f"`{name}`"):
        make(**{name: value})
