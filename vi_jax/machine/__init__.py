"""Machines in general: states, coordinates, contacts, events and cycles."""

# The names that other packages import.
# ruff: noqa: F401, I001
# fmt: off
from ..lanes import horner, sincos
from .base import (
    AbstractMachine, contacts_in, has_velocity, jumps_on_section, labels_in, listed, longest_step,
    names_on, number_on, renews,
)
from .clocks import (
    Prepared, as_logged, at_section, clock_in_words, clock_word, convert_start, cycle_time,
    cycles_in_words, frequency_ratio, in_clock, in_cycle_clock, in_cycle_state, is_alive,
    is_in_range, logged_turn, may_rest, observed_later, phase_at, prepared, scales_known,
)
from .contact_forces import closed_contacts, contact_forces
from .contacts import (
    Impact, added, check_takes, constrained_rate, contact_constraints, field_in, forces, impact_on,
    on_held_surfaces, push_gains, push_of, row_of, shown_modes, velocity_change,
)
from .coordinates import (
    Coordinate, Row, angles_in, component, has_component, is_angle, nearest_images, with_component,
    without_turns, wrap_angles,
)
from .cycles import Turn, counter_of, counts_turns, falling, rising, turn_of
from .delay import (
    Past, delays_valid, has_delays, history_before, lags_of, longest_delay, reading,
    recorded_numbers, with_some_past, without_past,
)
from .delay_chain import delay_chain, history_in, machine_of_chain, without_history
from .elimination import is_definite, solved
from .event import AbstractEvent, AbstractSwitch
from .events import (
    Reset, Switch, after_event, begin_modes, event_of, events_of_steps, guard_of,
    has_contact_friction, holds_anywhere, is_autonomous, is_compound, jump_of, section_number,
    sides_of, struck_modes,
)
from .friction import (
    ContactFriction, DryFriction, frictions_in, held_alone, pressed_contacts, settled_contacts,
    settled_modes, shared_loads, slip_in,
)
from .leaves import (
    by_name, check_again, check_leaf, check_name, components, first_few, in_rows, leaf, leaf_names,
    near_names, size_by, size_of, states_from_rows, with_leaf, with_leaves,
)
from .mechanical import Mechanical
from .modes import (
    HybridState, begun, constant_modes, history_of, modes_at_start, modes_of, own_modes, raveled,
    replaced, with_modes, without_modes,
)
from .overrides import is_builtin, overridden
from .parts import (
    at_stop, chosen_stop, clock_of, events_of, has_own_modes, limited_in, mode_number, others_of,
    outcomes_of, section_in, stops_of, stops_on, switches_of, with_earlier_clock,
)
from .printing import Shown, Summarized, in_words, known, number_in_words, plain, state_in_words
from .settle import strike
from .state import State, like
from .stop import AbstractContactLaw, HuntCrossley, PowerLaw, RigidStop, SoftStop, stop_in_words
from .units import (
    PLAIN, QUANTITIES, Stated, attributes, drive_speed, in_brackets, in_unit, name_in, quantity_of,
    stated, unit_of, units_of, with_unit, with_units,
)
