"""The page of an evaluation: a verdict, its samples to be asked one by one, and every table of the paper beside its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, fields
from typing import Literal

from tcpipe.learning import paper_tables as paper
from tcpipe.learning.baselines import GRASS_ONLY, OURS, PER_CLASS, describe_ratios
from tcpipe.learning.evaluation import EXPECTED
from tcpipe.learning.evaluation_facts import SPLITS, ErrorsByClass, Evaluation, Leakage
from tcpipe.learning.evaluation_figures import EvaluatedSamples, draw_paper_figures, make_page_data, sample_sections
from tcpipe.learning.metrics import ALL, LEAST, QUANTITIES, UNITS, Errors
from tcpipe.report.page import Number, Section, render_page, show_verdict
from tcpipe.tables.findings import PREDICTED, judge_again

FLOORS = {"label_floor": "label noise alone", "simulation_floor": "simulation's own floor"}
"""What an error can hardly be less than, and what the page calls it."""

MEASURES = {"rmse": "RMSE", "mape_percent": "MAPE"}
SCORES = {"held_percent": "held by 90 %", "nll": "NLL", "crps": "CRPS"}
"""How well a model told its own errors (`tcpipe.learning.metrics`)."""

COUNTED = (
    "Beside a MAPE stands of how many labels it is: those of at least "
    + ", ".join(f"{least:g} {UNITS[quantity]} ({quantity})" for quantity, least in LEAST.items())
    + ". "
)
_DIGITS = {"w": 2, "v": 3, "T": 3, "E": 2}
_CALLED = {"test": "test samples of the known area", "unseen": "the unseen area"}


def render_evaluation_page(
    found: Evaluation,
    samples: EvaluatedSamples,
    *,
    title: str,
    lead: str,
    before: Sequence[Section] = (),
    warnings: Sequence[str] = (),
) -> str:
    """Return the HTML page of what `evaluate` found; ``before`` and ``warnings`` come first."""
    audits = {split: format_leakage(found.splits[split].leakage) for split in found.ordered_splits}
    drawn = sample_sections(samples, audits)
    sections = [
        *before,
        _make_baselines_section(found),
        *drawn,
        *_make_class_sections(found),
        _make_ablation_section(found),
        _make_energy_section(found),
        _time(found),
        *draw_paper_figures(found.plots),
    ]
    return render_page(
        title=title,
        lead=lead,
        numbers=[
            Number(
                f"{found.splits[name].errors[quantity][ALL].mape_percent or float('nan'):.2f} %",
                f"MAPE of {quantity}, {name}, {found.splits[name].errors[quantity][ALL].mape_count} labels",
            )
            for name in found.ordered_splits
            for quantity in ("E", "T")
        ],
        verdict=show_verdict(judge_again(found.verdict, found.findings), found.findings, labels=PREDICTED),
        warnings=warnings,
        sections=[section for section in sections if section.rows or section.text],
        script="evaluation.js" if drawn else "",
        data=make_page_data(samples) if drawn else None,
    )


def list_evaluation_rows(found: Evaluation) -> list[tuple[str | int | float | None, ...]]:
    """Return every figure as one row: table, split, what, quantity, unit, class, then the fields of `Errors`."""
    rows = (*_iterate_class_rows(found), *_iterate_ablation_rows(found), *_iterate_comparison_rows(found))
    return [(*keys[:4], UNITS[keys[3]], keys[4], *astuple(error)) for keys, error in rows]


_Row = tuple[tuple[str, str, str, str, str], Errors]


def _iterate_class_rows(found: Evaluation) -> Iterator[_Row]:
    for split, part in found.splits.items():
        for what, by_quantity in {"errors": part.errors, **part.floors}.items():
            for quantity, by_class in by_quantity.items():
                for name, error in by_class.items():
                    yield ("by class", split, what, quantity, name), error
    for quantity, by_class in (found.blocks or {}).items():
        for name, error in by_class.items():
            yield ("by class", "held out", "blocks", quantity, name), error


def _iterate_ablation_rows(found: Evaluation) -> Iterator[_Row]:
    for row in found.ablation:
        for split in found.splits:
            for quantity, error in row.on(split).items():
                yield ("ablation", split, f"{'+'.join(row.layers)} {row.how}", quantity, ALL), error


def _iterate_comparison_rows(found: Evaluation) -> Iterator[_Row]:
    for table, quantity, by_predictor in (("energy", "E", found.energy), ("time", "T", found.time)):
        for what, by_split in by_predictor.items():
            for split, error in by_split.items():
                yield (table, split, what, quantity, ALL), error
    for row in found.baselines:
        yield ("baselines", row.split, row.baseline, row.quantity, ALL), row.errors


ERRORS = tuple(of.name for of in fields(Errors))

COLUMNS = ("table", "split", "what", "quantity", "unit", "class", "count", *ERRORS[1:])
"""Of `list_evaluation_rows`."""


def _format_figure(error: Errors | None, measure: str, quantity: str) -> str:
    value = None if error is None else getattr(error, measure)
    if error is None or value is None:
        return "–"
    if measure == "mape_percent":
        return f"{value:.2f} ({error.mape_count})"
    return f"{value:.{1 if measure == 'held_percent' else 2 if measure == 'nll' else _DIGITS[quantity]}f}"


def _format_paper_figure(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _find_unit(measure: str, quantity: str) -> str:
    return "%" if measure.endswith("percent") else "nat" if measure == "nll" else UNITS[quantity]


def _make_baselines_section(found: Evaluation) -> Section:
    """Return the model beside what is simplest, with the ratio to the best of these before it."""
    rows = []
    for split in found.ordered_splits:
        for quantity in QUANTITIES:
            ours = found.splits[split].errors[quantity][ALL]
            rows.append(
                (
                    split,
                    quantity,
                    "the model",
                    *(_format_figure(ours, measure, quantity) for measure in (*MEASURES, *SCORES)),
                    "",
                    "",
                )
            )
            for row in found.baselines:
                if (row.split, row.quantity) == (split, quantity):
                    figures = (_format_figure(row.errors, measure, quantity) for measure in MEASURES)
                    blank = [""] * len(SCORES)
                    rows.append(("", "", row.baseline, *figures, *blank, str(row.rmse_ratio), str(row.mape_ratio)))
    header = ("", "", "", "RMSE", "MAPE [%]", "held by 90 % [%]", "NLL", "CRPS", "ratio of RMSE", "ratio of MAPE")
    text = (
        "Fitted on the samples that the model was fitted on, measured on the same as it. Ratios are the model's error over the "
        "baseline's, with their 95 % interval (paired bootstrap over runs or blocks): below 1 the model is better. Physics and boosting "
        "are told the turn of each metre, too. "
    )
    text += f"{COUNTED}{'. '.join(describe_ratios(found.baselines))}. {format_audit(found)}"
    if not found.baselines:
        return Section("Beside what is simplest")
    return Section("Beside what is simplest", text, header=header, rows=rows, figures_from=3)


def _make_class_sections(found: Evaluation) -> list[Section]:
    """Return tables I and II."""
    sections = []
    for number, name in zip(("I", "II"), SPLITS, strict=True):
        if name not in found.splits:
            continue
        part = found.splits[name]
        classes = [*part.class_order, ALL]
        rows = []
        for quantity in QUANTITIES:
            for measure, called in MEASURES.items():
                ours = [_format_figure(part.errors[quantity].get(entry), measure, quantity) for entry in classes]
                rows.append((f"{quantity}, {called} [{_find_unit(measure, quantity)}]", "here", *ours))
                told = dict(zip(paper.CLASSES, paper.BY_CLASS[name, quantity, measure], strict=True))
                rows.append(("", "the paper", *(_format_paper_figure(told.get(entry)) for entry in classes)))
                if name == "test" and found.blocks is not None:
                    blocks = [_format_figure(found.blocks[quantity].get(entry), measure, quantity) for entry in classes]
                    rows.append(("", "held-out blocks of train", *blocks))
                for said, floors in _iterate_floors(found, name):
                    noise = [_format_figure(floors[quantity].get(entry), measure, quantity) for entry in classes]
                    rows.append(("", said, *noise))
                repeats = found.repeatability[quantity]
                if measure == "rmse" and repeats is not None:
                    blank = [""] * len(part.classes)
                    rows.append(("", "repeats to, driven again", *blank, f"{repeats.std:.{_DIGITS[quantity]}f}"))
            if part.errors[quantity][ALL].nll is not None:
                for score, called in SCORES.items():
                    ours = [_format_figure(part.errors[quantity].get(entry), score, quantity) for entry in classes]
                    rows.append((f"{quantity}, {called} [{_find_unit(score, quantity)}]", "here", *ours))
        header = ("", "", *(f"{entry} ({part.classes[entry]})" for entry in part.class_order), f"all ({part.samples})")
        sections.append(
            Section(
                f"Table {number}: {_CALLED[name]}",
                f"{_TEXT[name]} {_describe_error_samples(found)}{COUNTED}{format_leakage(part.leakage)}",
                header=header,
                rows=rows,
                figures_from=2,
            )
        )
    return sections


def _describe_error_samples(found: Evaluation) -> str:
    """Return what samples the model knows its own errors by, in words."""
    training = found.model.training
    count = training.samples["held out"]
    if training.config.model == "resnet18":
        return (
            f"Intervals, NLL and CRPS rest on its errors on the one fold of train that stopped it ({count} samples), which it fits a "
            "little too well: no second network was trained for them. "
        )
    return f"Intervals, NLL and CRPS rest on its errors on all {count} samples of train, each told by the other folds. "


def format_audit(found: Evaluation) -> str:
    """Return how much of each split was met in training, in words."""
    return " ".join(f"{split}: {format_leakage(found.splits[split].leakage)}" for split in found.ordered_splits)


def format_leakage(leakage: Leakage | None) -> str:
    """Return how much of a split was met in training, in words."""
    if leakage is None:
        return "Nothing is known of its distance from training."
    sharing = "" if leakage.sharing_percent is None else f"; {leakage.sharing_percent:.0f} % share ground with one"
    return (
        f"Audit (test held out by {leakage.holdout}): the middles of {leakage.near_percent:.0f} % of these samples are within "
        f"{leakage.within_m:.2f} m of a training sample's{sharing}."
    )


_TEXT = {
    "test": "Held-out blocks of train are those that the model was not fitted on (a network was stopped by them). "
    "Label noise alone is what a perfect prediction would show for the labels' own standard deviations.",
    "unseen": "The paper calls it validation; nothing was tuned or stopped by it.",
}


def _make_ablation_section(found: Evaluation) -> Section:
    """Return table III."""
    splits = found.ordered_splits
    rows = []
    for row in found.ablation:
        key = row.layers
        called, how = "{" + ", ".join(key) + "}", "retrained" if row.how == "retrained" else "here"
        for split in splits:
            figures = [
                _format_figure(row.on(split)[quantity], measure, quantity) for quantity, measure in _ABLATION_COLUMNS
            ]
            rows.append((called, split, how, *figures))
            if row.how == "noise" and key in paper.ABLATION:
                told = paper.ABLATION[key][SPLITS.index(split)]
                blank = [""] * len(SCORES)
                rows.append(("", "", "the paper", *(_format_paper_figure(value) for value in told), *blank))
    for split in splits:
        for said, floors in _iterate_floors(found, split):
            figures = [
                _format_figure(floors[quantity][ALL], measure, quantity) for quantity, measure in _ABLATION_COLUMNS
            ]
            rows.append((said, split, "", *figures))
    header = ("layers", "", "", *(f"{q} {(MEASURES | SCORES)[m]} [{_find_unit(m, q)}]" for q, m in _ABLATION_COLUMNS))
    draws = found.config.draws
    text = f"Layers not named are replaced by noise, mean of {draws} draws; retrained: a network that never had them. {COUNTED}"
    text += format_audit(found)
    return Section("Table III: ablation", text, header=header, rows=rows, figures_from=3)


_ABLATION_COLUMNS = (*paper.ABLATION_COLUMNS, *(("E", score) for score in SCORES))


def _iterate_floors(found: Evaluation, split: str) -> Iterator[tuple[str, ErrorsByClass]]:
    """Yield what errors on a split can hardly be less than: its name, and errors by quantity and class."""
    yield from ((FLOORS[floor], errors) for floor, errors in found.splits[split].floors.items())


def _make_comparison_section(
    title: str,
    text: str,
    found: Evaluation,
    told: Mapping[str, Sequence[tuple[float, float]]],
    quantity: Literal["E", "T"],
) -> Section:
    """Return table IV or V, beside what is told in the paper."""
    table = found.energy if quantity == "E" else found.time
    splits = found.ordered_splits
    rows = []
    for what, by_split in ((what, table[what]) for what in (OURS, GRASS_ONLY, PER_CLASS, EXPECTED) if what in table):
        cells = [
            _format_figure(by_split[split], measure, quantity) for split in splits for measure in (*MEASURES, *SCORES)
        ]
        rows.append((what, "here", *cells))
        if what in told:
            blank = [""] * len(SCORES)
            figures = [
                cell
                for split in splits
                for cell in (*map(_format_paper_figure, told[what][SPLITS.index(split)]), *blank)
            ]
            rows.append(("", "the paper", *figures))
    for floors in zip(*(_iterate_floors(found, split) for split in splits), strict=True):
        cells = [
            _format_figure(floor[quantity][ALL], measure, quantity)
            for _, floor in floors
            for measure in (*MEASURES, *SCORES)
        ]
        rows.append((floors[0][0], "", *cells))
    repeats = found.repeatability[quantity]
    if repeats is not None:
        rows.append(
            ("repeats to, driven again", "", *([f"{repeats.std:.{_DIGITS[quantity]}f}", "", "", "", ""] * len(splits)))
        )
    header = (
        "",
        "",
        *(
            f"{split}, {called} [{_find_unit(m, quantity)}]"
            for split in splits
            for m, called in (MEASURES | SCORES).items()
        ),
    )
    text += f" {COUNTED}{format_audit(found)}"
    return Section(title, text, header=header, rows=rows, figures_from=2)


def _make_energy_section(found: Evaluation) -> Section:
    text = (
        "Wei and Isler predict E from heights alone: one network of grass, or one for every class, each with as many steps as ours. "
        "All rows are of the same samples. "
    )
    ratios = "; ".join(f"{row.split}, {row.baseline}: {row.rmse_ratio}" for row in found.networks)
    text += (
        f"RMSE of ours over theirs, with its 95 % interval: {ratios}."
        if ratios
        else "They are trained beside a network only, and here none was."
    )
    return _make_comparison_section("Table IV: energy against Wei and Isler", text, found, paper.ENERGY, "E")


def _time(found: Evaluation) -> Section:
    text = "The expected time is d / v at the robot's greatest speed."
    return _make_comparison_section("Table V: time against the expected time", text, found, paper.TIME, "T")
