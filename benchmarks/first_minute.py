"""Compare the verdict of `tcpipe preflight` on a drive's first minute with that on the whole drive (docs/how-to/trust.md).

python benchmarks/first_minute.py DIRECTORY [SCENARIO …]
"""

import sys
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from tcpipe.pipeline.preflight import ExpectedYield, preflight
from tcpipe.recipe import Recipe
from tcpipe.simulation import simulate

DRIVES = (("demo", 0), ("paper_quick", 0), ("hills12", 1), ("hills12", 2))
MINUTE_NS = 60 * 10**9


def first_minute(log: Path, out: Path) -> Path:
    """Write what was logged in the first minute of a log, message by message."""
    with log.open("rb") as file, out.open("wb") as target:
        reader, writer, ids = make_reader(file), Writer(target), dict[int, int]()
        writer.start(profile="ros2")
        start_ns = reader.get_summary().statistics.message_start_time
        for schema, channel, message in reader.iter_messages(ending_before=start_ns + MINUTE_NS):
            if channel.id not in ids:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, kind, channel.metadata
                )
            writer.add_message(ids[channel.id], message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()
    return out


def promise_of(log: Path) -> tuple[ExpectedYield, str]:
    """Return what a log promises, and one sigma of its E."""
    found = preflight(log, recipe=Recipe())
    assert found.expected_yield is not None, found.problems
    std = found.expected_yield.relative_std_median["energy"]
    return found.expected_yield, "none" if std is None else f"{100 * std:.1f} %"


def main() -> None:
    directory = Path(sys.argv[1])
    print("| simulated drive | first minute promises | the whole log gives | off by | E ± 1 σ, minute and whole |")
    print("|---|---|---|---|---|")
    for name, seed in [(name, 0) for name in sys.argv[2:]] or DRIVES:
        place = directory / f"{name}-{seed}"
        log = next(log for log in simulate(place, scenario=name, seed=seed).logs if log.suffix == ".mcap")
        (minute, minute_std), (whole, whole_std) = promise_of(first_minute(log, place / "minute.mcap")), promise_of(log)
        said, std, gives = minute.segments_per_hour, minute.segments_per_hour_std, whole.segments_per_hour
        print(
            f"| `{name}` (seed {seed}), {whole.span_s:.0f} s | {said:.0f} ± {std:.0f} segments an hour | {gives:.0f} | "
            f"{100 * (said / gives - 1):+.0f} % | {minute_std}, {whole_std} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
