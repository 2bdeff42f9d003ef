"""Commands on models."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from tcpipe.cli.options import INPUT_DIRECTORY, OUTPUT_DIRECTORY, add_options, add_output, jobs_option
from tcpipe.learning.model_options import EvaluateOptions, TrainOptions
from tcpipe.planning.path_options import CostMapOptions, PlanPathOptions, PredictPathOptions, RouteGraphOptions

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tcpipe.experiment.benchmark import BenchmarkResult
    from tcpipe.experiment.reproduction import Reproduction, Size
    from tcpipe.learning.evaluation_files import EvaluationResult
    from tcpipe.learning.fitting import ModelKind
    from tcpipe.learning.training import TrainResult
    from tcpipe.planning.cost_map import CostMapResult
    from tcpipe.planning.drives import DrivesResult
    from tcpipe.planning.path_files import PathResult, PlanResult
    from tcpipe.planning.route_graph import RouteGraphResult


@click.command()
@add_options(TrainOptions)
@add_output("train")
def train(options: TrainOptions) -> TrainResult:
    """Train a model on DATASET and write it to the folder OUT.

    Without options: the simplest of curves, physics and boosted trees that predicts other runs as well as the best.
    --model resnet18, or an option of it, trains the paper's network. Boosted trees need pip install 'tcpipe[tables]', a
    network 'tcpipe[train]'; it uses a GPU if there is one, and an interrupted training resumes.
    """
    from tcpipe.api import run_train

    return run_train(options)


@click.command()
@add_options(EvaluateOptions)
@add_output("evaluate", as_values=True)
def evaluate(options: EvaluateOptions) -> EvaluationResult | DrivesResult:
    """Evaluate MODEL on DATASET's test samples and unseen area, and write evaluation.json and .html to OUT.

    RMSE and MAPE of power, velocity, time and energy by terrain class; baselines, centred by the same rule; the
    coverage of intervals; the ablation of the input layers; the expected time; the noise floor of the labels; all with
    the values of the paper. predictions.parquet has every prediction. OUT may be a URL in a bucket, where each
    evaluation has its own folder.

    With --drive: time and energy of whole drives, measured and predicted on the store's map, with intervals, in
    drives.json of OUT; DATASET, which MODEL was trained on, shows whether a drive was held back.
    """
    from tcpipe.api import run_evaluate

    return run_evaluate(options)


@click.command()
@click.argument("datasets", nargs=-1, required=True, type=INPUT_DIRECTORY, metavar="DATASET...")
@click.option(
    "--kinds", multiple=True, type=click.Choice(["linear", "physics", "boosting", "resnet18"]),
    help="Kind of model; repeatable (default: all).",
)  # fmt: skip
@click.option("--seeds", default=5, type=click.IntRange(1, 100), help="Number of trainings of each network.")
@click.option("--out", default="benchmark", type=OUTPUT_DIRECTORY, help="Directory of tables, models and evaluations.")
@click.option("--predictor", metavar="FILE.py[:NAME]", help="Your own model, compared with the other kinds.")
@add_output("benchmark", as_values=True)
def benchmark(
    datasets: Sequence[str], *, kinds: Sequence[ModelKind], seeds: int, out: str, predictor: str | None
) -> BenchmarkResult:
    """Train and evaluate every kind of model on every DATASET, and print the paper's table of each.

    RMSE and MAPE of power, velocity, energy and time by class, with 95 % intervals over runs and trainings; coverage,
    CRPS, training time, and the largest R² that the noise of the labels allows. Writes benchmark.json and .html; an
    interrupted call resumes.
    """
    from tcpipe.experiment.benchmark import KINDS, run_benchmark

    return run_benchmark(datasets, out, kinds=kinds or KINDS, seeds=seeds, predictor=predictor)


@click.command()
@click.argument("directory", default="tcpipe-reproduction", type=OUTPUT_DIRECTORY, metavar="[DIR]")
@click.option(
    "--size",
    type=click.Choice(["full", "small", "quick"]),
    default="full",
    help="The paper's site; a small site with a narrow network; or the small site for a few epochs, as a test.",
)
@click.option(
    "--seeds", default=1, type=click.IntRange(1, 100), help="Number of trainings; five or more decide the claims."
)
@jobs_option("Logs read")
@click.option(
    "--baselines/--no-baselines", default=True,
    help="Also train networks on single classes, with all layers, and as Wei and Isler (takes most of the time).",
)  # fmt: skip
@add_output("reproduce")
def reproduce(directory: str, *, size: Size, seeds: int, jobs: int, baselines: bool) -> Reproduction:
    """Simulate the paper's site, drive it, build the dataset, train, evaluate, and test the claims of the paper.

    Runs 'tcpipe benchmark' on it. Takes some two hours a training on two cores, minutes with --size small; an
    interrupted call resumes. The data are simulated: compare the pattern with the paper, not the numbers. Writes
    reproduction.html, reproduction.json and all intermediate results to DIR.
    """
    from tcpipe.experiment.reproduction import reproduce as run

    return run(directory, size=size, seeds=seeds, jobs=jobs, baselines=baselines)


@click.command("predict-path")
@add_options(PredictPathOptions)
@add_output("predict-path")
def predict_path(options: PredictPathOptions) -> PathResult:
    """Predict time and energy of a path and of each of its segments of one metre, with intervals.

    The command marks and counts path segments that MODEL cannot predict (class, slope or relief outside the training
    range, outside the map, no data, not traversable). Exit code 3: some path segments have no cost.
    """
    from tcpipe.api import run_predict_path

    return run_predict_path(options)


@click.command("cost-map")
@add_options(CostMapOptions)
@add_output("cost-map")
def cost_map(options: CostMapOptions) -> CostMapResult:
    """Predict power, velocity, and time and energy per metre, along 16 courses in every cell of a map.

    Writes to OUT (default: cost-map) Cloud-Optimised GeoTIFFs with one band per course, the reasons where MODEL cannot
    predict, and maps for Nav2. An interrupted call resumes; OUT may be a URL in a bucket, where each map is a folder of
    its own.
    """
    from tcpipe.planning.cost_map import make_cost_map
    from tcpipe.planning.path_files import load_inputs

    inputs = load_inputs(options)
    return make_cost_map(*inputs, options.out, cell_size_m=options.cell_size, origin_deg=options.origin)


@click.command("plan-path")
@add_options(PlanPathOptions)
@add_output("plan-path")
def plan_path(options: PlanPathOptions) -> PlanResult:
    """Find the path of least energy, time or distance between two points; costs depend on the direction of travel.

    Writes GeoJSON to --out, and beside it a nav_msgs/Path (.path.json) and the goal of Nav2's FollowGPSWaypoints
    (.waypoints.json). Exit code 3: parts of the path have no cost, because --cell-size is large, or the budget is too
    small.
    """
    from tcpipe.api import run_plan_path

    return run_plan_path(options)


@click.command("route-graph")
@add_options(RouteGraphOptions)
@add_output("route-graph")
def route_graph(options: RouteGraphOptions) -> RouteGraphResult:
    """Write time, energy and their standard deviations into a graph of Nav2's route server, for each directed edge.

    Exit code 3: some edges have no cost; they are left out.
    """
    from tcpipe.planning.path_files import load_inputs
    from tcpipe.planning.route_graph import write_route_graph

    out, graph = Path(options.out), Path(options.graph)
    inputs = load_inputs(options)
    return write_route_graph(*inputs, out, graph=graph, origin_deg=options.origin, two_way=options.two_way)
