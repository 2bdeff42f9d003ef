"""Names of tcpipe 0.8 and data model 2.x, with their names since 0.9 and 3.0: tcpipe still reads the earlier ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

EARLIER_COLUMNS = {
    "epoch": "clock_epoch",
    "turn_rad": "yaw_change_rad",
    "turn_std_rad": "yaw_change_std_rad",
    "turn_rate_radps": "mean_abs_yaw_rate_radps",
    "turn_rate_std_radps": "mean_abs_yaw_rate_std_radps",
    "standing_power_watt": "idle_power_watt",
    "standing_power_std_watt": "idle_power_std_watt",
    "power_above_standing_watt": "net_power_watt",
    "power_above_standing_std_watt": "net_power_std_watt",
    "energy_above_standing_joule": "net_energy_joule",
    "energy_above_standing_std_joule": "net_energy_std_joule",
}
"""Columns of tables; `tcpipe.formats.parquet` gives them their names of today."""

EARLIER_KEYS = {
    "gate": "mask",
    "gate.standing_velocity_mps": "stationary_velocity_mps",
    "gate.standing_yaw_rate_radps": "stationary_yaw_rate_radps",
    "read.time": "time_source",
    "read.placement": "extrinsics",
    "read.pose_from": "pose_sources",
    "robots.*.called": "topic_words",
    "power_sources.*.refused": "unsupported_reason",
    "power_sources.*.includes": "other_loads",
    "power_sources.*.unknown": "open_questions",
}
"""Keys of the recipe by their path; * is any name or item."""

EARLIER_DOCUMENT_KEYS = {
    **EARLIER_COLUMNS,
    "gate": "mask",
    "ledger_m": "distance_by_reason_m",
    "ledger_s": "duration_by_reason_s",
    "standing_watt": "idle_watt",
    "standing_updates": "zero_velocity_updates",
    "standing": "stationary",
    "below_limit": "below_full_speed",
    "not_at_limit": "below_full_speed",
    "mean_power_differs": "power_mean_mismatch",
    "reopenings": "gate_resets",
    "refused": "excluded",
    "remarks": "notes",
    "pitch_m": "pixel_size_m",
    "doubtful": "flagged_samples",
    "usual_turn_radpm": "mean_turn_radpm",
}
"""Keys of manifests and cards; `tcpipe migrate` renames them."""


EARLIER_MODEL_KEYS = {
    "beside": "extra_features",
    "seen": "training_range",
    "batch": "batch_size",
    "weights": "inverse_variance_weights",
    "usual_turn_radpm": "mean_turn_radpm",
    "standing": "idle",
}
"""Keys of model.json."""


def rename_keys(document: Any, names: Mapping[str, str] = EARLIER_DOCUMENT_KEYS) -> Any:
    """Return a document, or a part of one, with keys by their names of today."""
    if isinstance(document, list):
        return [rename_keys(item, names) for item in document]
    if not isinstance(document, Mapping):
        return document
    return {names.get(key, key): rename_keys(value, names) for key, value in document.items()}


EARLIER_CHOICES = {"table": "boosting", "above_standing": "net"}
"""Values of options."""
