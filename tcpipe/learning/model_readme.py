"""The model card for people: ``MODEL.md``."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
from jinja2 import Environment, StrictUndefined

from tcpipe.dataset.energies import ENERGIES
from tcpipe.errors import clean_line
from tcpipe.learning.model_card import ModelCard

_TEXT = """# Terrain-cost model

Predicts {{ outputs }} of {{ chord }} m of ground ahead of the robot from a patch of map:
mean power w [W] and velocity v [m/s] give T = d / v and E = w d / v with d = {{ chord }} m.

- Takes float32 (N, {{ px }}, {{ px }}, {{ depth }}) in [0, 1]: {{ channels }}; a patch is {{ patch }} m wide, travel to the right.
{% if extra_features -%}
- Also takes: {{ extra_features }}.
{% endif -%}
- Velocity is the {{ velocity }} one; power is {{ energy }}; robot {{ robot }}.
{%- if includes %}
  What was measured feeds {{ includes }}, too.
{%- endif %}
{% if config.model == "boosting" -%}
- Table: a curve over the slope of each class, and up to {{ told.best_epoch }} boosted trees a label over features of the patch (LightGBM),
  as many as are best where each fold of train is predicted by the others; the loss {{ config.loss }} there is
  {{ "%.4f" | format(told.held_out_loss) }}.
{% elif config.model == "physics" -%}
- Physics: standing, drivetrain, grade, and rolling and turning of each class, at a speed that is a curve over class and slope; fitted
  robustly. Its loss {{ config.loss }} where each fold of train is predicted by the others is {{ "%.4f" | format(told.held_out_loss) }}.
  Of a patch it takes slope and class, which `predict` takes as extra features.
{% else -%}
- Network: ResNet-18 of width {{ width }}; loss {{ config.loss }}, Adam {{ config.learning_rate }}, batch {{ config.batch_size }},
  seed {{ config.seed }}; best of {{ told.epochs }} epochs by fold {{ config.fold }} of train: {{ told.best_epoch }},
  loss {{ "%.4f" | format(told.held_out_loss) }}. Its intervals rest on its errors on the
  {{ told.samples["held out"] }} samples of that one fold, which it fits a little too well.
{% endif -%}
- Trained on {{ told.samples["fitted"] }} samples of {{ dataset.name }}, checksum {{ dataset.sha256 }}.
- Seen: {{ classes }}; slope {{ slope }}; relief of a patch {{ relief }}. Beyond these it has no business.

```python
from tcpipe.learning.models import load_model

load_model("model").predict(patches)
```
"""


def model_readme(card: ModelCard) -> str:
    """Return the text of MODEL.md."""
    names = {entry.id: entry.name for entry in card.classes}
    counts = (
        f"{_escape_markdown(str(names.get(class_id, class_id)))} {count}"
        for class_id, count in card.training_range.class_counts.items()
    )
    dataset = replace(card.dataset, name=_escape_markdown(card.dataset.name))
    return Environment(autoescape=False, undefined=StrictUndefined, keep_trailing_newline=True).from_string(_TEXT).render(  # noqa: S701  Markdown
        outputs=", ".join(card.outputs), chord=f"{card.chord_m:g}", px=card.architecture.patch_px,
        depth=card.architecture.depth, channels=", ".join(card.channels), patch=f"{card.patch_m:g}",
        velocity=card.label_velocity, energy=ENERGIES[card.label_energy].words,
        extra_features=", ".join(f"{of.name} (usually {of.usual:.3g})" for of in card.extra_features),
        includes="; ".join(map(_escape_markdown, card.label_includes)), robot=card.robot, width=card.architecture.width,
        config=card.training.config, told=card.training, dataset=dataset, classes=", ".join(counts),
        slope=" to ".join(f"{np.degrees(value):.1f}°" for value in card.training_range.ranges["slope_rad"]),
        relief=" to ".join(f"{value:.2f} m" for value in card.training_range.ranges.get("relief_m", ())) or "not looked at",
    )  # fmt: skip


def _escape_markdown(name: str) -> str:
    """Return a name as text that Markdown takes for nothing else."""
    return re.sub(r"([\\`*_\[\]<>|#~])", r"\\\1", clean_line(name))
