"""The truth gate: its errors are drawn as they are stated, its figures find labels that are sure and wrong, and it runs."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import welch

sys.path.append(str(Path(__file__).parent))

import honesty
import honesty_cells as cells
from campaign_drives import Outcome, simulated

HERE = Path(honesty.__file__).parent
RATE_HZ = 5.0


def at(duration_s: float, **values) -> SimpleNamespace:
    """Return times, with whatever else a family reads of the truth."""
    return SimpleNamespace(stamp_ns=np.arange(round(duration_s * RATE_HZ)) * round(1e9 / RATE_HZ), **values)


def rng(seed: int = 4) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.mark.parametrize(("std_m", "tau_s"), [(0.008, 5.0), (0.02, 20.0)])
def test_gauss_markov_noise_has_its_size_and_correlation_time(std_m, tau_s):
    error = cells.gauss_markov(std_m, tau_s)(at(20_000.0), rng())
    assert error.std(axis=0) == pytest.approx(std_m * np.array([1.0, 1.0, cells.UP]), rel=0.08)
    lag = round(tau_s * RATE_HZ)
    kept = [np.corrcoef(column[:-lag], column[lag:])[0, 1] for column in error.T]
    assert np.mean(kept) == pytest.approx(np.exp(-1.0), abs=0.06)
    assert np.abs(np.corrcoef(error.T) - np.eye(3)).max() < 0.15


def test_the_spectrum_of_flicker_noise_falls_as_one_over_f():
    drawn = [cells.flicker(0.01)(at(2000.0), rng(seed))[:, :2] for seed in range(12)]
    assert np.sqrt(np.mean(np.square(drawn))) == pytest.approx(0.01, rel=0.15)
    frequency, density = welch(np.concatenate(drawn, axis=1), RATE_HZ, nperseg=4096, axis=0)
    inside = (frequency > 0.005) & (frequency < 0.5)
    slope, _ = np.polyfit(np.log(frequency[inside]), np.log(density.mean(axis=1)[inside]), 1)
    assert slope == pytest.approx(-1.0, abs=0.08)


def test_multipath_depends_on_the_place_alone():
    x, y = rng(1).uniform(0.0, 200.0, (2, 3000))
    there = at(600.0, x_map_m=x, y_map_m=y)
    error = np.array([cells.multipath(0.03)(there, rng(seed)) for seed in range(8)])
    assert np.sqrt(np.mean(np.square(error[..., :2]))) == pytest.approx(0.03, rel=0.05)
    back = at(600.0, x_map_m=x[::-1], y_map_m=y[::-1])
    np.testing.assert_allclose(cells.multipath(0.03)(back, rng(0)), error[0][::-1])
    near = at(600.0, x_map_m=x + 0.05, y_map_m=y)
    assert np.abs(cells.multipath(0.03)(near, rng(0)) - error[0]).max() < 0.03


def test_constellations_change_at_their_rate():
    error = cells.steps(0.05, 25.0)(at(50_000.0), rng())
    changes = np.any(np.diff(error, axis=0) != 0.0, axis=1)
    assert changes.sum() == pytest.approx(2000, rel=0.1)
    assert error[:, :2].std() == pytest.approx(0.05, rel=0.1)


def test_ramps_and_excursions_have_their_size_and_leave_nothing():
    ramp = np.linalg.norm(cells.ramps(0.3)(at(240.0), rng()), axis=1)
    assert ramp.max() == pytest.approx(0.3)
    assert ramp[0] == ramp[-1] == 0.0
    rises = np.diff(ramp) * RATE_HZ
    assert 0.3 / 30.0 <= rises.max() <= 0.3 / 10.0
    bump = np.linalg.norm(cells.excursion(0.4, 40.0)(at(240.0), rng()), axis=1)
    assert bump.max() == pytest.approx(0.4, rel=0.01)
    assert np.count_nonzero(bump > 1e-9) == pytest.approx(40.0 * RATE_HZ, abs=2)
    assert np.abs(np.diff(bump)).max() * RATE_HZ == pytest.approx(0.4 * np.pi / 40.0, rel=0.02)
    wrong = np.linalg.norm(cells.wrong_fix(0.5, 60.0)(at(240.0), rng()), axis=1)
    assert sorted(set(wrong.round(9))) == [0.0, 0.5]
    assert np.count_nonzero(wrong) == pytest.approx(60.0 * RATE_HZ, abs=1)


def test_scales_follow_what_they_are_named_after():
    truth = simulated("valley", 1, 60.0).truth
    uphill, downhill = truth.slope_rad > 0.05, truth.slope_rad < -0.05
    scale = cells.by_slope(0.10)(truth, rng())
    assert (scale[uphill].mean() - 1.0) * (scale[downhill].mean() - 1.0) < 0.0
    by_class = cells.by_terrain(0.10)(truth, rng())
    for terrain in np.unique(truth.terrain_class):
        assert np.ptp(by_class[truth.terrain_class == terrain]) == 0.0
    by_load = cells.by_load(0.10)(truth, rng())
    assert np.corrcoef(by_load, truth.power_watt)[0, 1] < -0.5
    for values in (scale, by_class, by_load):
        assert 0.02 < np.abs(values - 1.0).max() <= 0.10 + 1e-9


def test_a_stated_arm_is_some_centimetres_off_in_any_direction():
    shifts = np.array([cells.some_centimetres(rng(seed)) for seed in range(400)])
    assert np.linalg.norm(shifts, axis=1).max() <= 0.10
    assert np.linalg.norm(shifts, axis=1).mean() == pytest.approx(0.05, rel=0.1)
    assert np.abs(shifts.mean(axis=0)).max() < 0.01


def test_a_slipped_antenna_turns_with_the_robot():
    truth = simulated("valley", 1, 60.0).truth
    error = cells.moved_antenna(0.3)(truth, rng())
    half = truth.stamp_ns.size // 2
    assert not error[: half - 1].any()
    np.testing.assert_allclose(np.linalg.norm(error[half + 1 :], axis=1), 0.3)
    assert np.ptp(error[half + 1 :], axis=0)[:2].max() > 0.1


@pytest.mark.parametrize("seconds", [-3.0, 3.0])
def test_true_times_of_a_stepped_clock_are_those_of_the_truth(seconds):
    drive = simulated("valley", 1, 60.0)
    fault = cells.step_host_clock(seconds)
    half_ns = int(drive.truth.stamp_ns[0] + drive.truth.stamp_ns[-1]) // 2
    true_ns = half_ns + np.array([-10, -5, 5, 10]) * 10**9
    recorded_ns = true_ns + np.array([0, 0, 1, 1]) * round(seconds * 1e9)
    np.testing.assert_array_equal(fault.true_ns(recorded_ns, drive), true_ns)
    assert fault.true_ns(np.array([half_ns + round(0.5e9 * seconds)]), drive)[0] < drive.first_ns


def outcome(count: int = 200, *, sigma: float = 1.0, bits: int = 0) -> Outcome:
    """Return labels whose errors are as large as they claim, or not."""
    names = honesty.QUANTITIES
    draw = rng(7)
    error = {name: draw.standard_normal(count).tolist() for name in names}
    error["start"] = np.abs(draw.rayleigh(np.sqrt(0.5), count)).tolist()
    claimed = {name: [sigma] * count for name in names}
    return Outcome(
        np.arange(float(count)).tolist(), error, claimed, [bits] * count, [True] * count, 200.0, 200.0, 200.0, 200.0, [],
        track={"xy_m": 0.01, "velocity_mps": 0.01, "yaw_rad": 0.01},
    )  # fmt: skip


@pytest.fixture
def cell() -> cells.HonestCell:
    return next(cell for cell in cells.honest_cells() if cell.name == "all: fix 0.5 m wrong for 60 s")


def misses(cell: cells.HonestCell, made: Outcome, base: Outcome) -> list[str]:
    return honesty.figures_of(cell, [made], [base]).misses


def test_labels_that_are_as_wrong_as_they_claim_miss_nothing(cell):
    good = replace(outcome(), said=["gnss: contradicts the other sensors [gnss-contradicts-odometry]"])
    assert misses(cell, good, outcome()) == []
    clean = honesty.figures_of(cell.base, [outcome()], [outcome()])
    assert clean.misses == []
    assert clean.lost == 0


def test_sure_and_wrong_lost_and_silent_are_missed(cell):
    said = ["gnss: contradicts the other sensors [gnss-contradicts-odometry]"]
    sure = misses(cell, replace(outcome(sigma=0.5), said=said), outcome())
    assert any(miss.startswith("T ") for miss in sure)
    assert any(miss.startswith("start ") for miss in sure)
    assert misses(cell, replace(outcome(bits=1 << 8), said=said), outcome()) == ["100% lost"]
    assert misses(cell, outcome(), outcome()) == ["named in 0%"]
    jitter = replace(outcome(), said=["gnss: stamps of 2 % of the fixes jitter [stamp-jitter]"])
    assert misses(cell, jitter, outcome()) == ["named in 0%"]
    assert misses(cell, replace(outcome(), said=said), replace(outcome(), said=said)) == ["named in 0%"]
    gone = replace(outcome(0), said=said, track={})
    assert misses(cell, gone, outcome()) == ["100% lost"]
    wide = honesty.figures_of(cell.base, [outcome(sigma=2.0)], [outcome()])
    assert any("RMS" in miss for miss in wide.misses)


def test_what_is_common_to_a_drive_is_judged_apart(cell):
    """A common error of one deviation leaves the own part calibrated; one of five is missed."""
    missed = {}
    for times in (1.0, 5.0):
        made = outcome()
        made.common["E"] = [3.0] * 200
        made.value.update(E=[30.0] * 200, T=[1.0] * 200)
        made.claimed["E"] = [float(np.hypot(1.0, 3.0))] * 200
        made.error["E"] = (np.array(made.error["E"]) + 3.0 * times).tolist()
        figures = honesty.figures_of(cell.base, [made], [outcome()])
        assert figures.common["E"] == pytest.approx(times, abs=0.1)
        assert figures.inside("E", 1.0, own=True) == pytest.approx(0.68, abs=0.06)
        missed[times] = figures.misses
    assert missed[1.0] == []
    assert any("common" in miss for miss in missed[5.0])


def test_a_wrong_label_that_is_doubted_is_not_lost(cell):
    wrong = outcome(bits=1 << 8)
    wrong.error["T"] = [5.0] * 200
    assert not any("lost" in miss for miss in misses(cell, wrong, outcome()))


def test_two_files_are_compared_drive_by_drive(tmp_path):
    first, second = {("all: clean", 1): outcome()}, {("all: clean", 1): outcome(), ("all: clean", 2): outcome()}
    second["all: clean", 1].error["T"][3] += 4.0
    for name, outcomes in (("a", first), ("b", second)):
        honesty.write(tmp_path / f"{name}.json", outcomes)
    lines = list(honesty.compare(honesty.read(tmp_path / "a.json"), honesty.read(tmp_path / "b.json")))
    assert len(lines) == 2
    assert lines[1].split()[2:6] == ["1", "200", "0.00", "4.0"]


def test_cells_are_named_once_and_the_gate_has_sixty():
    names = [cell.name for cell in cells.honest_cells()]
    assert len(names) == len(set(names))
    assert sum(not cell.wide for cell in cells.honest_cells()) >= 60


def test_a_cached_drive_gives_the_same_labels(tmp_path, monkeypatch, capsys):
    made = []
    for name in ("a", "b"):
        out = tmp_path / f"{name}.json"
        options = f"--cells ^GNSS,.wheels:.wheels --seeds 1 --length 50 --out {out} --cache {tmp_path / 'cache'}"
        monkeypatch.setattr(sys, "argv", ["honesty.py", *options.split()])
        honesty.main()
        assert "2 drives" in capsys.readouterr().out
        made.append(honesty.read(out))
    assert made[0].keys() == made[1].keys()
    for key, outcome in made[0].items():
        assert outcome.error == made[1][key].error
