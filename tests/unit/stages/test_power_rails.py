"""The track's columns and the labels sample one power: averaging sources, repeated stamps, a rail that falls silent."""

import numpy as np
import pytest
from made_tracks import power_streams, stamps, straight_track

from tcpipe.power.energy import IdlePower, integrate_energy
from tcpipe.recipe import GateConfig, SegmentConfig
from tcpipe.stages.fuse_sections import make_power_columns
from tcpipe.stages.label import compute_segment_costs
from tcpipe.stages.mask import mask_track
from tcpipe.stages.message_arrays import make_rails
from tcpipe.stages.segment import segment_track
from tcpipe.tables.columns import to_integers
from tcpipe.tables.levels import Streams

ZERO = stamps(1)[0]


def seconds(*values):
    return ZERO + np.round(np.array(values) * 1e9).astype(np.int64)


def track_watt(streams, at_ns):
    return make_power_columns(streams, 0, at_ns, max_gap_ns=300_000_000)["power_watt"]


@pytest.mark.parametrize("averaged", [True, False])
def test_the_track_has_the_power_that_the_label_takes_at_a_segments_end(averaged):
    # At 1 Hz 30 W and 300 W in turns: between two samples an interpolated value is up to ten times one held back.
    stamp_ns = seconds(*range(-1, 61)) + 700_000_000
    streams = power_streams(
        {"drive": (stamp_ns, np.full(62, 30.0), np.where(np.arange(62) % 2, 10.0, 1.0))}, averaged=averaged
    )
    gated = mask_track(straight_track(np.full(1200, 0.8)), GateConfig(), max_velocity_mps=1.0, chord_m=1.0)
    cut = segment_track(gated, SegmentConfig()).table
    rule = "averaged" if averaged else "exact"
    unknown, rails = IdlePower(np.nan, np.nan), make_rails(streams, 0)
    cost, _, causes = compute_segment_costs(cut, gated.table, rails, gated.info, rule=rule, standing=unknown)
    label_watt = np.sqrt(causes["position"]) / cost.duration_std_s
    assert cut.num_rows > 40
    assert label_watt == pytest.approx(track_watt(streams, to_integers(cut, "end_ns")))
    assert averaged == (set(np.round(label_watt, 6)) == {30.0, 300.0})


def test_of_several_samples_at_one_stamp_all_take_the_first():
    streams = power_streams({"drive": (seconds(0, 1, 1, 2), np.full(4, 10.0), np.array([1.0, 2.0, 30.0, 1.0]))})
    assert track_watt(streams, seconds(0.5, 1.0)) == pytest.approx([15.0, 20.0])
    assert integrate_energy(make_rails(streams, 0), seconds(0.0), seconds(2.0), rule="exact") == pytest.approx([30.0])


def test_where_one_rail_is_silent_for_an_epoch_nobody_knows_the_power():
    both = power_streams({n: (seconds(0, 1), np.full(2, 10.0), np.ones(2)) for n in ("left", "right")})
    table = both.tables["power"]
    epoch = np.array([0, 0, 1, 1], dtype=np.int16)  # the right rail has rows in epoch 1 alone
    streams = Streams(
        {"power": table.set_column(table.column_names.index("epoch"), table.schema.field("epoch"), [epoch])},
        {},
        "husky",
    )
    assert np.isnan(track_watt(streams, seconds(0.5))).all()
    assert np.isnan(integrate_energy(make_rails(streams, 0), seconds(0.0), seconds(1.0), rule="exact")).all()
