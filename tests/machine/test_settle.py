"""Forces, modes and impulses of contacts fulfil the conditions of contact."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from vi_jax.machine.settle import (
    Contacts,
    Strike,
    _decide_in_turn,
    _decide_one,
    _decide_quickly,
    settle,
    strike,
)

N, D = 4, 2
"""All questions are padded to four contacts with friction and two dry frictions, in batches of 240,
so that one program answers them."""
ANSWER = jax.jit(jax.vmap(lambda x: settle(x, tuple(range(N)))))
BLOWS = jax.jit(jax.vmap(lambda x: strike(x, (0, 1))))


def padded(J, inverse_mass, force, friction, slip=0.0, dry=()):
    """Return the `Contacts` of contacts with the rows J (normals, tangents, dry frictions)."""
    J = np.atleast_2d(np.asarray(J, float))
    n, d = len(friction), len(dry)
    at = np.array([*range(n), *range(N, N + n), *range(2 * N, 2 * N + d)])
    gains, rates = np.eye(2 * N + D), np.zeros(2 * N + D)
    gains[np.ix_(at, at)] = J @ inverse_mass @ J.T
    rates[at] = J @ inverse_mass @ np.asarray(force, float)
    friction, level = np.pad(friction, (0, N - n)), np.pad(np.array(dry, float), (0, D - d))
    slips = np.zeros(N + D)
    slips[at[n:] - N] = slip
    return Contacts(gains, rates, friction, np.arange(N) < n, slips, level, np.ones(N + D))


def each(function, questions):
    """Return the results of a function of a batch of questions, one for each question."""
    found, count = [], len(questions)
    for begin in range(0, count, 240):
        batch = [questions[min(i, count - 1)] for i in range(begin, begin + 240)]
        result = function(jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *batch))
        result = jax.tree.map(np.asarray, result)
        found += [jax.tree.map(lambda x, i=i, r=result: x[i], result) for i in range(240)]
    return found[:count]


def random_question(rng, number):
    """Return a question of up to four contacts and two dry frictions. Its rows are independent,
    those of points of a planar body, or linearly dependent."""
    n, d = number % 4 + 1, (number // 4) % 3
    kind, mu = number % 3, rng.choice([0, 1e-12, 0.3, 0.6, 2], n)
    if kind == 0:
        rows = rng.normal(size=(2 * n + d, 2 * n + d + 1))
    else:
        x, y, turn = rng.normal(size=n), -np.abs(rng.normal(size=n)), rng.uniform(-0.5, 0.5, n)
        if kind == 2:  # on one edge
            y, turn = np.full(n, -1.0), np.zeros(n)
        s, c = np.sin(turn), np.cos(turn)
        normal = np.stack([-s, c, x * c + y * s], 1)
        rows = np.concatenate([
            normal, np.stack([c, s, x * s - y * c], 1), rng.normal(size=(d, 3))
        ])  # fmt: skip
    half = rng.normal(size=(rows.shape[1],) * 2)
    inverse = half @ half.T + 0.1 * np.eye(len(half))
    force = 3 * rng.normal(size=rows.shape[1])
    slip = rng.choice([-1.0, 1.0], n + d) if number % 5 == 0 else 0.0
    return padded(rows, inverse, force, mu, slip, 2 * rng.uniform(size=d))


def violation(asked, answer):
    """Return by how much an answer violates the conditions of contact, in units of the rates."""
    lam, n = answer.force, N
    a = asked.gains @ lam + asked.rates
    size = np.abs(asked.rates).max() + (np.abs(asked.gains) @ np.abs(lam)).max()
    own = np.diag(asked.gains)
    push, drag = lam[:n], lam[n:]
    bound = np.concatenate([asked.friction * np.maximum(push, 0), asked.level])
    shut = asked.closed
    on = np.concatenate([shut, asked.level > 0])
    wrong = [np.where(shut, np.minimum(a[:n], 0), 0), np.minimum(push, 0) * own[:n]]
    wrong += [np.where(shut, a[:n], 0) * (push * own[:n] > 1e-10 * size)]
    free, given = on & (asked.slip == 0), on & (asked.slip != 0)
    beyond = np.where(free, np.maximum(np.abs(drag) - bound, 0), 0) * own[n:]
    wrong += [beyond, np.where(given, drag + asked.slip * bound, 0) * own[n:]]
    # Inside the bound nothing slips; at it the force opposes the slip.
    inside = free & ((bound - np.abs(drag)) * own[n:] > 1e-10 * size)
    drags = free & (np.abs(drag) * own[n:] > 1e-10 * size)
    along = np.where(drags, np.sign(drag) * a[n:], 0)
    wrong += [np.where(inside, a[n:], 0), np.maximum(along, 0)]
    return max(np.abs(x).max() for x in wrong) / size


def solutions_with_given_slip(asked):
    """Return how many sets of contacts are consistent if all slips are given."""
    n, found = int(asked.closed.sum()), 0
    columns = asked.gains[:, :N] - asked.gains[:, N : 2 * N] * (asked.friction * asked.slip[:N])
    rates = asked.rates - asked.gains[:, 2 * N :] @ (asked.slip[N:] * asked.level)
    for pushed_ones in itertools.product([False, True], repeat=n):
        on = np.flatnonzero(pushed_ones)
        matrix = columns[np.ix_(on, on)]
        if len(on) and np.linalg.cond(matrix) > 1e10:
            continue
        push = np.linalg.solve(matrix, -rates[on]) if len(on) else np.zeros(0)
        opens = columns[:n][:, on] @ push + rates[:n]
        found += (push >= 0).all() and (np.delete(opens, on) >= 0).all()
    return found


@pytest.mark.parametrize("count", [240, pytest.param(3000, marks=pytest.mark.slow)])
def test_random_questions_are_answered(count):
    """Without slip a solution always exists. With given slips there may be none (Painlevé)."""
    rng = np.random.default_rng(count)
    questions = [random_question(rng, i) for i in range(count)]
    unsolved = lost = 0
    for asked, answer in zip(questions, each(ANSWER, questions), strict=True):
        assert not np.isnan(answer.force).any()
        if answer.unsolved:
            assert asked.slip.any()
            unsolved += 1
            lost += solutions_with_given_slip(asked) > 0
        else:
            assert violation(asked, answer) < 1e-10
    assert 0 < unsolved < count / 10
    # Lemke's method may end in a ray although a solution exists.
    assert lost <= 0.01 * count


def random_frictions(rng, number, contacts):
    """Return a question of contacts and dry frictions, three in all; in every fourth the rows are
    dependent."""
    rows = rng.normal(size=(3, 4))
    rows[2] = rows[1] - rows[0] if number % 4 == 0 else rows[2]
    gains, force = rows @ rows.T, rng.normal(size=4)
    slip = rng.choice([-1.0, 0, 0, 0, 1.0], 3)[contacts:]
    hold = rng.choice([1.0, 1.0, 1.3, 1 - 1e-6], 3)[contacts:]
    level = rng.uniform(size=3)[contacts:] * rng.choice([0, 0.3, 3, 30])
    closed = rng.uniform(size=contacts) < 0.7
    return Contacts(gains, rows @ force, np.zeros(0), closed, slip, level, hold)


@pytest.mark.parametrize("contacts", [0, 1, 2])
def test_contacts_without_friction_settle_as_by_lemkes_method(contacts):
    rng = np.random.default_rng(1 + contacts)
    questions = [random_frictions(rng, i, contacts) for i in range(2400)]
    both = jax.jit(jax.vmap(lambda x: (_decide_quickly(x), _decide_in_turn(x, (), True))))
    found, expected = (
        jax.tree.map(lambda *x: np.stack(x), *answers)
        for answers in zip(*each(both, questions), strict=True)
    )
    np.testing.assert_array_equal(found.code, expected.code)
    np.testing.assert_array_equal(found.holds, expected.holds)
    np.testing.assert_array_equal(found.mode, expected.mode)
    np.testing.assert_array_equal(found.pushes, expected.pushes)
    np.testing.assert_allclose(found.force, expected.force, rtol=0, atol=1e-9)
    sticks, begins = found.holds, (found.mode != 0) & (np.stack([x.slip for x in questions]) == 0)
    assert (begins.sum(1) == 1).sum() > 100 and sticks.all(1).sum() > 100  # both happen
    opens = np.stack([x.closed for x in questions]) & ~found.pushes
    assert not contacts or (opens.sum(1) == 1).sum() > 100


def test_one_contact_with_friction_settles_as_by_lemkes_method():
    rng = np.random.default_rng(9)
    questions = []
    for _ in range(2400):
        rows = rng.normal(size=(2, 3))
        friction = rng.choice([0, 0.5, 3, 10], 1) * rng.uniform()
        closed, slip = rng.uniform(size=1) < 0.9, rng.choice([-1.0, 0, 0, 1.0], 1)
        rates = rows @ rng.normal(size=3)
        questions.append(
            Contacts(rows @ rows.T, rates, friction, closed, slip, np.zeros(0), np.ones(1))
        )
    both = jax.jit(jax.vmap(lambda x: (_decide_one(x), _decide_in_turn(x, (0,), False))))
    for one, lemke in each(both, questions):
        assert one.code == lemke.code and one.holds == lemke.holds and one.pushes == lemke.pushes
        np.testing.assert_allclose(one.force, lemke.force, rtol=1e-9, atol=1e-9)
        assert one.mode == lemke.mode or not lemke.pushes  # a slip without force is decided later


def test_random_impacts_keep_the_conditions():
    """No contact closes, no impact gains energy, impulses are in the cone of friction, and friction
    that goes to zero changes nothing."""
    rng = np.random.default_rng(4)
    cases = []
    for i in range(240):
        x = random_question(rng, 12 * i + 1)
        at = [0, 1, N, N + 1]
        gains, v = x.gains[np.ix_(at, at)], x.rates[at]
        v[:2] = -np.abs(v[:2]) * [1, i % 4 > 0]
        mu, e = [(0, 0), (1e-12, 1e-12), (0.3, 0.3), (0.3, 1.5)][i % 4], rng.choice([0, 0.5, 1], 2)
        cases.append(Strike(gains, v, np.array(mu), e, np.zeros(2), v[:2] < 0))
    smooth = [x._replace(friction=0 * x.friction) for x in cases]
    blows = each(BLOWS, [*cases, *smooth])
    impulses, unsolved = [x.impulse for x in blows], [x.unsolved for x in blows]
    assert sum(unsolved) <= 1
    for i, x in enumerate(cases):
        p = impulses[i]
        after, size = x.velocity + x.gains @ p, np.abs(x.velocity).max()
        if unsolved[i]:
            continue
        assert (np.where(x.struck, after[:2], 0) > -1e-11 * size).all()
        assert (p[:2] >= -1e-14).all()
        assert (np.abs(p[2:]) <= x.friction * p[:2] + 1e-12 * np.abs(p).max()).all()
        gain = p @ (after + x.velocity) / 2
        assert gain <= 1e-11 * np.abs(p @ x.velocity)
        if i % 4 <= 1:
            change = x.gains @ (p - impulses[len(cases) + i])
            np.testing.assert_allclose(change, 0, atol=3e-10 * size)


def test_a_rod_strikes_the_ground_with_much_friction():
    """P. Painlevé's rod with friction beyond his bound, which slides into the ground or away from
    it: for one direction of slip, a push with its friction would close the contact."""
    s, c, mu = np.sin(1), np.cos(1), 1.6
    cases = []
    for side, speed in itertools.product((1, -1), (0.2, 3, 10, -0.2, -3, -10)):
        rows = np.array([[0, 1, -side * c], [1, 0, s]])
        gains = rows @ np.diag([1, 1, 3]) @ rows.T
        one, two = np.eye(2)[0], np.eye(2)
        gains = np.kron(gains, np.diag([1, 0])) + np.kron(two, np.diag([0, 1]))
        cases.append(Strike(gains, np.array([-1, 0, -side * speed, 0]), mu * np.ones(2),
                            0.5 * np.ones(2), np.zeros(2), one > 0))  # fmt: skip
    for x, blow in zip(cases, each(BLOWS, cases), strict=True):
        after = x.velocity + x.gains @ blow.impulse
        assert not blow.unsolved and blow.impulse[0] > 0
        assert after[0] == pytest.approx(0.5 * blow.share, abs=1e-12)
        drag, level = blow.impulse[2], mu * blow.impulse[0]
        assert abs(drag) <= level + 1e-12
        # The slip stops, or friction has its bound against it.
        assert (
            blow.share < 1
            or abs(after[2]) < 1e-12
            or drag == pytest.approx(-level * np.sign(after[2]))
        )
        assert blow.impulse @ (after + x.velocity) <= 1e-12


def test_a_foot_that_others_hold_is_spare():
    """Feet of a body in a row, in any order, with the load between two of them: only these push. A
    load on the middle one is carried by the others: it could carry them alone, but then nothing
    would hold these. A load beyond the last one opens the others."""

    def question(places, load):
        rows = [[0, 1, x] for x in places] + [[1, 0, 1]] * len(places)
        return padded(rows, np.eye(3), [0.5, -9.81, -9.81 * load + 0.5], [0.9] * len(places))

    orders = list(itertools.permutations((-0.4, 0.1, 0.4)))
    loads = (-0.2, 0.2, 0.3)
    found = each(ANSWER, [question(x, load) for x in orders for load in loads])
    for answer in found:
        assert answer.kept[:3].all() and answer.spare[:3].sum() == 1
        assert (answer.spare[:3] == (answer.force[:3] == 0)).all()
    middle = each(ANSWER, [question(x, 0.1) for x in orders])
    for places, answer in zip(orders, middle, strict=True):
        assert answer.kept[:3].all() and (answer.spare[:3] == (np.array(places) == 0.1)).all()
        shares = np.interp(places, (-0.4, 0.1, 0.4), (0.375, 0, 0.625))
        np.testing.assert_allclose(answer.force[:3], 9.81 * shares, atol=1e-12)
    over = each(ANSWER, [question(x, 0.6) for x in orders])
    for places, answer in zip(orders, over, strict=True):
        assert (answer.kept[:3] == (np.array(places) == 0.4)).all() and not answer.spare.any()
