"""Sigma points against Jacobians, and filter and smoother against one large least-squares problem."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from unit.fusion import se3_reference as reference

from tcpipe.fusion import error_state, state
from tcpipe.fusion.error_state import filter_section, make_tests, smooth_section
from tcpipe.fusion.filter_kernel import GateVerdict, Memory, TickInputs, allocate_steps, filter_ticks
from tcpipe.fusion.measurements import Measurements
from tcpipe.fusion.parameters import Event, make_model
from tcpipe.fusion.smoother_kernel import (
    DISPLACEMENT_INTERVAL_TICKS,
    Adjoint,
    Candidates,
    Smoothed,
    make_adjoint,
    smooth_ticks,
    step_before_motion,
    step_before_update,
)
from tcpipe.fusion.state import Error, Kind, Mode
from tcpipe.fusion.ticks import Ticks

T = 0.05
MODES = (Mode.FLAT_TURN, Mode.VISUAL_TURN, Mode.GYRO_TURN, Mode.INERTIAL)
FAULTY = range(Error.GYRO_BIAS, state.N)
"""Errors that may be known exactly."""
seeds = st.integers(0, 2**32 - 1)
subsets = st.sets(st.sampled_from(FAULTY))


def make_state(rng):
    """Return a state anywhere, with parameters of a usual size."""
    x = 0.05 * rng.normal(size=state.NX)
    x[:9] = Rotation.random(rng=rng).as_matrix().ravel()
    x[9:12], x[12:15] = rng.normal(size=3), rng.normal(size=3)
    x[Error.ARM + 6 : Error.ARM + 9] = rng.normal(size=3)
    return x


def make_covariance(rng, size, std):
    root = rng.normal(size=(size, size)) / np.sqrt(size) + 0.3 * np.eye(size)
    return std**2 * root @ root.T


def make_inputs(count, rng, mode=Mode.INERTIAL, *, noise=0.0, kept=1.0):
    """Return ticks of random motion without measurements."""
    turned, gained = np.zeros((count, 9)), np.zeros((count, 6))
    for k in range(count):
        turn = rng.normal(size=3) * T
        turned[k, :3] = turn
        if mode >= Mode.GYRO_TURN:
            turned[k] = Rotation.from_rotvec(turn).as_matrix().ravel()
        gained[k] = np.concatenate(
            ((rng.normal(size=3) + reference.G) * T, (rng.normal(size=3) + reference.G) * T**2 / 2)
        )
    shape = count, state.KINDS
    return TickInputs(
        T,
        np.full(count, mode, np.int8),
        turned,
        gained,
        np.full((count, 6), noise),
        rng.normal(size=(count, 3)),
        np.full(count, mode >= Mode.GYRO_TURN),
        rng.normal(size=count),
        np.full((*shape, 3), np.nan),
        np.ones((*shape, 3)),
        rng.uniform(-T / 2, T / 2, shape),
        rng.normal(size=(state.KINDS, 3)),
        np.full(count, kept),
        np.full((count, 3), noise),
        rng.normal(size=(count, 3)),
    )


def look_at(inputs, k, kind):
    acceleration = np.array([inputs.acceleration[k], 0.0, 0.0])
    lever = inputs.attitude[k] if kind == Kind.ATTITUDE else inputs.levers[kind]
    return reference.Look(inputs.rate[k], bool(inputs.has_gyro[k]), acceleration, inputs.tau[k, kind], lever)


def model_of(free, *, walk=0.0):
    """Return the model in which the errors of ``free`` are not known exactly; its gates let everything pass."""
    std = np.zeros(state.N)
    std[sorted(free)] = 1.0
    walks = np.full(state.N, 0.0)
    walks[sorted(free)] = walk
    model = make_model(Measurements(), std, walks, (), period_s=T, gate_probability=0.999)
    return model._replace(gates=np.full(state.KINDS, np.inf))


def filter_all(inputs, model, memory):
    """Return what each tick keeps for the smoother, and the states."""
    count = inputs.mode.size
    steps = allocate_steps(count, model.active.size)
    filter_ticks(0, count, inputs, model, memory, steps, make_tests(count))
    return steps, steps.x


def differentiate(function, count, step=1e-6):
    """Return the Jacobian by central differences."""
    ahead = [np.atleast_1d(function(step * e)) - np.atleast_1d(function(-step * e)) for e in np.eye(count)]
    return np.array(ahead).T / (2 * step)


@pytest.mark.parametrize("mode", MODES)
@settings(max_examples=10, deadline=None)
@given(seed=seeds, free=subsets)
def test_motion_maps_small_errors_by_its_jacobian(mode, seed, free):
    rng = np.random.default_rng(seed)
    x, inputs, model = make_state(rng), make_inputs(2, rng, mode), model_of(free)
    tick = reference.Tick(mode, T, inputs.turned[1], inputs.gained[1])
    wanted = reference.differentiate_motion(x, tick)
    centre = reference.move(x, tick)
    numeric = differentiate(lambda d: reference.minus(reference.move(reference.plus(x, d), tick), centre), state.N)
    assert np.allclose(wanted, numeric, atol=1e-7)

    P = make_covariance(rng, model.active.size, 1e-4)
    memory = Memory(x.copy(), P.copy(), np.zeros((state.KINDS, 2)))
    steps, states = filter_all(inputs, model, memory)
    F = wanted[np.ix_(model.active, model.active)]
    assert np.allclose(reference.minus(states[1], centre), 0.0, atol=1e-12)
    assert np.allclose(steps.P[1], F @ P @ F.T, atol=1e-12)
    used = model.depends[state.KINDS + (mode >= Mode.GYRO_TURN)]
    used = used[: model.counts[state.KINDS + (mode >= Mode.GYRO_TURN)]]
    assert np.allclose(steps.F[1][: used.size, : used.size], F[np.ix_(used, used)], atol=1e-6)
    others = np.delete(np.arange(model.active.size), used)
    assert np.allclose(F[:, others], np.eye(model.active.size)[:, others], atol=0.0)


@pytest.mark.parametrize("kind", range(state.KINDS))
@settings(max_examples=10, deadline=None)
@given(seed=seeds, free=subsets, mode=st.sampled_from(MODES))
def test_each_measurement_maps_small_errors_by_its_jacobian(kind, seed, free, mode):
    rng = np.random.default_rng(seed)
    x, inputs, model = make_state(rng), make_inputs(1, rng, mode), model_of(free)
    inputs.attitude[0] = Rotation.from_matrix(x[:9].reshape(3, 3)).as_rotvec()
    look, size = look_at(inputs, 0, kind), state.SIZES[kind]
    wanted = reference.differentiate_measurement(kind, x, look)
    numeric = differentiate(lambda d: reference.expect(kind, reference.plus(x, d), look), state.N)
    assert np.allclose(wanted, numeric, atol=1e-7)

    R = np.diag(rng.uniform(0.5, 2.0, size)) * 1e-8
    z = reference.expect(kind, x, look) + 1e-4 * rng.normal(size=size)
    inputs.value[0, kind, :size], inputs.variance[0, kind, :size] = z, np.diag(R)
    P = make_covariance(rng, model.active.size, 1e-4)
    memory = Memory(x.copy(), P.copy(), np.zeros((state.KINDS, 2)))
    steps, states = filter_all(inputs, model, memory)
    H = wanted[:, model.active]
    assert np.allclose(steps.H[0, kind][:size], H, atol=2e-3 if kind >= Kind.DOPPLER else 5e-4)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    y = z - reference.expect(kind, x, look)
    moved = np.zeros(state.N)
    moved[model.active] = K @ y
    scale = np.sqrt(np.diag(P))
    off = (reference.minus(states[0], reference.plus(x, moved))[model.active]) / scale
    assert np.abs(off).max() < 2e-3
    assert np.allclose(steps.P[0] / np.outer(scale, scale), (P - K @ S @ K.T) / np.outer(scale, scale), atol=2e-3)


def test_a_wide_covariance_passes_as_a_cloud_does():
    """With 20 degrees of yaw and an antenna 2 m ahead a Jacobian says that fixes scatter sideways only, by 0.70 m."""
    rng = np.random.default_rng(3)
    x, model, inputs = np.zeros(state.NX), model_of(()), make_inputs(1, rng, Mode.FLAT_TURN)
    x[:9], x[Error.ARM + 6] = np.eye(3).ravel(), 2.0
    P = np.diag([1e-8, 1e-8, np.radians(20.0) ** 2, *[1e-8] * 6])
    inputs.value[0, Kind.FIX], inputs.variance[0, Kind.FIX] = 0.0, 1e-4
    inputs.tau[:], inputs.rate[:], inputs.acceleration[:] = 0.0, 0.0, 0.0
    tests = make_tests(1)
    memory = Memory(x.copy(), P.copy(), np.zeros((state.KINDS, 2)))
    filter_ticks(0, 1, inputs, model, memory, allocate_steps(0, 9), tests)
    yaw = np.radians(20.0) * rng.normal(size=400_000)
    cloud = 2.0 * np.stack((np.cos(yaw) - 1.0, np.sin(yaw)), -1)
    second = cloud.T @ cloud / yaw.size + np.eye(2) * 1e-4
    assert tests.log_det[0, Kind.FIX] == pytest.approx(np.log(np.linalg.det(second) * 1e-4), abs=0.15)
    assert second[0, 0] > 100 * 1e-4


class Problem:
    """A drive of 2.4 s whose measurements are drawn from the model, with its solution by one least-squares problem over all ticks.

    Unknown are the error at the start and the noise of each tick, each over its standard deviation: ``free``.
    """

    def __init__(self, seed, mode, ticks=48):
        rng = np.random.default_rng(seed)
        free = {*FAULTY} - {*range(Error.FIX_OFFSET, Error.FIX_OFFSET + 3), Error.SHARED_SCALE, Error.VISUAL_SLIP}
        free -= set() if mode >= Mode.GYRO_TURN else {*range(Error.GYRO_BIAS, Error.ARM)}
        walking = {Error.WHEEL_SCALE, Error.VISUAL_SCALE} | ({*range(Error.GYRO_BIAS, Error.ARM)} & free)
        std, walk = np.zeros(state.N), np.zeros(state.N)
        std[sorted(free)], walk[sorted(walking)] = 0.01, 0.003
        self.inputs = make_inputs(ticks, rng, mode, noise=1e-6, kept=0.9)
        self.model = make_model(Measurements(), std, walk, (), period_s=T, gate_probability=0.999)
        self.model.gates[:] = np.inf
        n = self.model.active.size
        self.P = np.diag(np.square(np.concatenate((np.full(9, 0.01), std[self.model.active[9:]]))))
        self.x = np.zeros(state.NX)
        self.x[:9], self.x[12] = np.eye(3).ravel(), 1.0
        self.x[Error.ARM + 6 : Error.ARM + 9] = 0.3, 0.1, 0.5
        variance = self.model.noise.copy()
        for places, added in ((range(3), 1e-6), (range(Error.U, Error.U + 3), 1e-6), (range(19, 22), 1e-6)):
            variance[np.isin(self.model.active, places)] += added
        self.noisy = np.flatnonzero(variance)
        self.std = np.sqrt(variance[self.noisy])
        self.free = n + (ticks - 1) * self.noisy.size
        self.rows = []
        true, _ = self.play(rng.normal(size=self.free))
        for k in range(ticks):
            for kind in set(range(state.KINDS)) - {Kind.STATIONARY, Kind.STATIONARY_RATE}:
                if k % (2 + kind) == 0:
                    self.inputs.attitude[k] = Rotation.from_matrix(true[k][:9].reshape(3, 3)).as_rotvec()
                    size = state.SIZES[kind]
                    self.inputs.variance[k, kind, :size] = 0.01**2
                    noise = 0.01 * rng.normal(size=size)
                    look = look_at(self.inputs, k, kind)
                    self.inputs.value[k, kind, :size] = reference.expect(kind, true[k], look) + noise
                    self.rows.append((k, kind))

    def step(self, before, d, G, places):
        """Return the state displaced by d at ``places`` of the active errors, and G, which stands before it, in its axes."""
        whole = np.zeros(state.N)
        whole[self.model.active[places]] = d
        turn = reference.exp(-whole[:3])
        G = G.copy()
        G[:3], G[3:6] = turn @ G[:3], turn @ G[3:6]
        return reference.plus(before, whole), G, reference.right_jacobian(whole[:3])

    def play(self, free):
        """Return the states, and the Jacobian of each state's active errors."""
        model, n = self.model, self.model.active.size
        x, G, J = self.step(self.x, np.sqrt(np.diag(self.P)) * free[:n], np.zeros((n, self.free)), np.arange(n))
        G[:, :n] = np.sqrt(self.P)
        G[:3, :n] = J @ G[:3, :n]
        G[3:6] = reference.exp(-np.sqrt(self.P[0, 0]) * free[:3]) @ G[3:6]
        states, maps = [x], [G]
        for k in range(1, self.inputs.mode.size):
            tick = reference.Tick(int(self.inputs.mode[k]), T, self.inputs.turned[k], self.inputs.gained[k])
            F = reference.differentiate_motion(x, tick)[np.ix_(model.active, model.active)]
            x, G = reference.move(x, tick), F @ G
            x[Error.FIX_ERROR + 6 : Error.FIX_ERROR + 9] *= 0.9
            G[np.isin(model.active, range(19, 22))] *= 0.9
            columns = n + (k - 1) * self.noisy.size + np.arange(self.noisy.size)
            x, G, J = self.step(x, self.std * free[columns], G, self.noisy)
            G[self.noisy, columns] += self.std
            G[:3, columns] = J @ G[:3, columns]
            states.append(x)
            maps.append(G)
        return np.array(states), maps

    def solve(self):
        """Return the states, the Jacobians, and the covariance of what is free."""
        free = np.zeros(self.free)
        for _ in range(4):
            states, maps = self.play(free)
            lines, residuals = [np.eye(free.size)], [free]
            for k, kind in self.rows:
                size = state.SIZES[kind]
                look = look_at(self.inputs, k, kind)
                H = reference.differentiate_measurement(kind, states[k], look)[:, self.model.active]
                lines.append(-H @ maps[k] / 0.01)
                residuals.append((self.inputs.value[k, kind, :size] - reference.expect(kind, states[k], look)) / 0.01)
            J, r = np.vstack(lines), np.concatenate(residuals)
            covariance = np.linalg.inv(J.T @ J)
            free = free - covariance @ J.T @ r
        return *self.play(free), covariance

    def smooth(self):
        stamp_ns = np.arange(self.inputs.mode.size, dtype=np.int64) * 50_000_000
        ticks = Ticks(stamp_ns, self.inputs, {}, np.ones((stamp_ns.size, 3)))
        memory = Memory(self.x.copy(), self.P.copy(), np.zeros((state.KINDS, 2)))
        return smooth_section(filter_section(ticks, self.model, memory))[0]


@pytest.mark.parametrize("mode", MODES)
def test_filter_and_smoother_solve_the_least_squares_problem_of_all_ticks(monkeypatch, mode):
    monkeypatch.setattr(error_state, "_BLOCK", 17)
    problem = Problem(11, mode)
    found = problem.smooth()
    states, maps, covariance = problem.solve()
    active, at = problem.model.active, range(0, len(maps), 2)
    for k in at:
        wanted = maps[k] @ covariance @ maps[k].T
        off = reference.minus(found.states[k], states[k])[active] / np.sqrt(np.diag(wanted))
        assert np.abs(off).max() < 0.1
        R = states[k][:9].reshape(3, 3)
        position = R @ wanted[3:6, 3:6] @ R.T
        assert np.diag(position) == pytest.approx(found.variances[k, :3], rel=0.02)
        assert wanted[6, 6] == pytest.approx(found.variances[k, 4], rel=0.02)
        mount = [list(active).index(e) for e in range(Error.MOUNT, Error.MOUNT + 3)]
        turned = maps[k][:3] + maps[k][mount]
        robot = R @ (np.eye(3) + reference.skew(states[k][Error.MOUNT + 6 : Error.MOUNT + 9]))

        def compute_yaw(d, R=robot):
            ahead = R @ reference.exp(d)
            return np.arctan2(ahead[1, 0], ahead[0, 0])

        by_turn = differentiate(compute_yaw, 3)
        assert (by_turn @ turned @ covariance @ turned.T @ by_turn.T)[0, 0] == pytest.approx(
            found.variances[k, 3], rel=0.02
        )
        for column, lag in enumerate((10, 20, 40)):
            if k + lag >= len(maps) or (k + lag) % DISPLACEMENT_INTERVAL_TICKS:
                assert np.isnan(found.displacement_m2[k, column])
                continue
            after = states[k + lag][:9].reshape(3, 3) @ maps[k + lag][3:6]
            between = (after - R @ maps[k][3:6])[:2]
            along = states[k + lag][9:11] - states[k][9:11]
            along /= np.linalg.norm(along)
            variance = along @ between @ covariance @ between.T @ along
            assert variance == pytest.approx(found.displacement_m2[k, column], rel=0.02)
    spread = np.sqrt(np.diag(maps[0] @ covariance @ maps[0].T))
    assert spread == pytest.approx(found.stds[0], rel=0.01)


@settings(max_examples=12, deadline=None)
@given(seed=seeds, free=subsets, kinds=st.sets(st.sampled_from(range(state.KINDS))), mode=st.sampled_from(MODES))
def test_what_no_measurement_shows_keeps_its_prior_and_what_is_exact_stays(seed, free, kinds, mode):
    rng = np.random.default_rng(seed)
    inputs, model = make_inputs(30, rng, mode, noise=1e-5), model_of(free)
    inputs.fix_noise[:] = 0.0
    for kind in kinds:
        inputs.value[::2, kind, : state.SIZES[kind]] = rng.normal(size=(15, state.SIZES[kind]))
    x, n = make_state(rng), model.active.size
    std = rng.uniform(0.01, 0.3, n)
    memory = Memory(x.copy(), np.diag(std**2), np.zeros((state.KINDS, 2)))
    steps, states = filter_all(inputs, model, memory)

    for P in steps.P:
        assert np.array_equal(P, P.T)
        scale = np.sqrt(np.diag(P))
        assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > -1e-12

    exact = np.setdiff1d(FAULTY, model.active) + 6
    assert np.array_equal(states[:, exact], np.tile(x[exact], (30, 1)))

    moves = model.depends[state.KINDS + (mode >= Mode.GYRO_TURN)][
        : model.counts[state.KINDS + (mode >= Mode.GYRO_TURN)]
    ]
    shown = {*moves, *(i for kind in kinds for i in model.depends[kind][: model.counts[kind]])}
    hidden = sorted(set(range(n)) - shown)
    stamp_ns = np.arange(30, dtype=np.int64) * 50_000_000
    ticks = Ticks(stamp_ns, inputs, {}, np.ones((30, 3)))
    smoothed, _ = smooth_section(filter_section(ticks, model, Memory(x, np.diag(std**2), np.zeros((state.KINDS, 2)))))
    assert np.array_equal(smoothed.stds[0, hidden], np.sqrt(std[hidden] ** 2))
    places = model.active[hidden] + 6
    assert np.array_equal(smoothed.states[:, places], np.tile(x[places], (30, 1)))


@pytest.mark.parametrize("place", [Error.WHEEL_SCALE, Error.GYRO_BIAS, Error.ARM])
def test_evidence_of_an_event_is_what_it_gains_in_log_likelihood(place):
    problem = Problem(11, Mode.INERTIAL)
    size, std = problem.inputs.mode.size, 0.05
    entry = list(problem.model.active).index(place)

    def filter_with(model):
        steps, tests = allocate_steps(size, model.active.size), make_tests(size)
        memory = Memory(problem.x.copy(), problem.P.copy(), np.zeros((state.KINDS, 2)))
        filter_ticks(0, size, problem.inputs, model, memory, steps, tests)
        return steps, -0.5 * np.nansum(tests.nis + tests.log_det)

    steps, likelihood = filter_with(problem.model)
    row, best = (np.full((1, 9), value) for value in (entry, std)), np.full((1, 20), -np.inf)
    candidates = Candidates(*row, np.ones(1, np.int64), 1, best)
    empty = Smoothed(*(np.zeros((size, width)) for width in (state.NX, 5, 1, problem.model.active.size)))
    adjoint = make_adjoint(problem.model.active.size, 0)
    smooth_ticks(0, size, problem.inputs, problem.model, steps, np.array([10]), adjoint, candidates, empty)
    evidence, tick = best[0, :2]
    event = np.array([[int(tick), entry, 0]])
    changed = filter_with(problem.model._replace(events=event, sizes=np.array([std**2]), shifts=np.zeros(1)))[1]
    assert evidence == pytest.approx(changed - likelihood, rel=0.05, abs=0.02)


def filter_stationary(kind, displace, noise):
    """Return tests and states of a stationary robot whose measurements of one kind ``displace`` changes."""
    inputs, model = make_inputs(120, np.random.default_rng(4), Mode.FLAT_TURN, noise=noise), model_of(())
    model.gates[kind] = 16.27
    inputs.rate[:], inputs.turned[:], inputs.acceleration[:], inputs.tau[:] = 0.0, 0.0, 0.0, 0.0
    inputs.value[:, Kind.STATIONARY], inputs.variance[:, Kind.STATIONARY] = 0.0, 1e-4
    inputs.value[:, kind], inputs.variance[:, kind] = 0.0, 1e-4
    inputs.attitude[:] = 0.0
    displace(inputs)
    model.patience_s[kind] = 2.0
    x = np.zeros(state.NX)
    x[:9] = np.eye(3).ravel()
    tests, steps = make_tests(120), allocate_steps(120, 9)
    filter_ticks(0, 120, inputs, model, Memory(x, np.eye(9) * 1e-4, np.zeros((state.KINDS, 2))), steps, tests)
    return tests, steps.x


def test_rejections_in_a_row_open_the_gate_again():
    def move(inputs):
        inputs.value[40:, Kind.FIX, 0] = 5.0

    tests, states = filter_stationary(Kind.FIX, move, noise=1e-6)
    assert (tests.verdict[:40, Kind.FIX] == GateVerdict.ACCEPTED).all()
    reset = int(np.flatnonzero(tests.verdict[:, Kind.FIX] == GateVerdict.RESET)[0])
    assert reset * T == pytest.approx(39 * T + 2.0, abs=T)
    assert (tests.verdict[40:reset, Kind.FIX] == GateVerdict.REJECTED).all()
    assert np.abs(states[39:reset, 9]).max() < 0.01
    assert (tests.verdict[reset + 1 :, Kind.FIX] == GateVerdict.ACCEPTED).all()
    assert states[-1, 9] == pytest.approx(5.0, abs=0.05)


def test_an_attitude_that_is_rejected_for_long_is_followed():
    def turn(inputs):
        inputs.attitude[40:, 2] = 1.0

    tests, states = filter_stationary(Kind.ATTITUDE, turn, noise=1e-8)
    reset = int(np.flatnonzero(tests.verdict[:, Kind.ATTITUDE] == GateVerdict.RESET)[0])
    assert reset * T == pytest.approx(39 * T + 2.0, abs=T)
    assert (tests.verdict[reset + 1 :, Kind.ATTITUDE] == GateVerdict.ACCEPTED).all()
    assert np.arctan2(states[-1, 3], states[-1, 0]) == pytest.approx(1.0, abs=0.02)


def test_an_event_makes_an_error_uncertain_or_another_one():
    rng = np.random.default_rng(4)
    inputs = make_inputs(10, rng)
    std = np.zeros(state.N)
    std[[Error.WHEEL_SCALE, Error.VISUAL_SCALE]] = 0.1
    events = (
        Event(5, Error.WHEEL_SCALE, 0.3, 0.2),
        Event(7, Error.VISUAL_SCALE, is_new=True),
        *(Event(6, Error.ARM + axis, 0.4) for axis in range(3)),
    )
    model = make_model(Measurements(), std, np.zeros(state.N), events, period_s=T, gate_probability=0.999)
    x, n = make_state(rng), model.active.size
    place = {e: i for i, e in enumerate(model.active)}
    P = np.diag(np.square(np.concatenate((np.full(9, 0.1), std[model.active[9:]]))))
    P[place[Error.VISUAL_SCALE], place[Error.VISUAL_SCALE]] = 0.05**2  # known better than by its prior
    steps, states = filter_all(inputs, model, Memory(x.copy(), P, np.zeros((state.KINDS, 2))))
    spread = np.sqrt(np.array([np.diag(of) for of in steps.P]))
    assert n == 9 + 2 + 3
    assert spread[4:6, place[Error.WHEEL_SCALE]] == pytest.approx([0.1, np.hypot(0.1, 0.3)])
    assert spread[6:8, place[Error.VISUAL_SCALE]] == pytest.approx([0.05, 0.1])
    assert spread[5:7, place[Error.ARM]] == pytest.approx([0.0, 0.4])
    assert states[6, Error.VISUAL_SCALE + 6] == x[Error.VISUAL_SCALE + 6]
    assert states[7, Error.VISUAL_SCALE + 6] == 0.0
    assert states[9, Error.WHEEL_SCALE + 6] == x[Error.WHEEL_SCALE + 6] + 0.2


def test_rounding_of_the_smoothers_information_does_not_grow():
    """Whatever rounding adds to one half of Λ, P - P Λ P is a covariance at every tick, with constant errors too."""
    rng, n, ticks = np.random.default_rng(3), 6, 5_000
    covariance, noise = np.diag(rng.uniform(0.1, 1.0, n)), np.zeros(n)
    noise[:3] = 1e-4
    rows = rng.normal(size=(ticks, 1, n))
    gains, inverses, filtered = np.empty((ticks, 1, n)), np.empty((ticks, 1, 1)), np.empty((ticks, n, n))
    for k, H in enumerate(rows):
        S = H @ covariance @ H.T + 1.0
        gains[k], inverses[k] = (covariance @ H.T / S).T, 1.0 / S
        keep = np.eye(n) - gains[k].T @ H
        covariance = keep @ covariance @ keep.T + gains[k].T @ gains[k]
        filtered[k] = covariance
        covariance = covariance + np.diag(noise)
    information = np.zeros((n, n))
    adjoint = Adjoint(information, np.zeros((1, n)), np.full(0, -1), np.zeros((0, 5)))
    turn, places, room = np.tile(np.eye(3).ravel(), 2), np.arange(3), np.zeros((n, 2 * n + 3))
    for k in range(ticks - 1, -1, -1):
        smoothed = filtered[k] - filtered[k] @ information @ filtered[k]
        assert np.linalg.eigvalsh(0.5 * (smoothed + smoothed.T)).min() > 0.0, k
        step_before_update(gains[k], rows[k], 1, np.zeros(1), inverses[k], turn, adjoint, room)
        information += 1e-9 * rng.normal() * np.abs(information).max() * (np.eye(n, k=1) - np.eye(n, k=-1))
        step_before_motion(np.eye(3), np.ones(n), places, 3, adjoint, np.zeros((n, n)))
    assert np.array_equal(information, information.T)
